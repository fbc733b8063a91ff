"""Turn errors of the hub's client into HubErrors that state what happened and what to do, without a token."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from hma_data.errors import HMAError, HubError
from hma_data.storage.fetch import BUSY, causes, hidden, without_secrets

LOG_IN = "log in with hf auth login, or set HF_TOKEN"
RUN_AGAIN = "run the same command again to continue"
LONGEST_WAIT = 300.0  # seconds; the hub counts requests over five minutes


@contextmanager
def explained(where: str) -> Iterator[None]:
    """Raise what the client raises in the `with` block as a HubError."""
    try:
        yield
    except HMAError:
        raise
    except Exception as fault:  # the client and its libraries raise exceptions of any kind
        raise explain(where, without_secrets(fault, _hidden)) from fault


def explain(where: str, fault: BaseException) -> HubError:
    """Return the HubError for an error of the client or of the disk."""
    import httpx
    from huggingface_hub import errors

    name, cause = type(fault).__name__, fault.__cause__ or fault.__context__
    if isinstance(fault, ValueError) and isinstance(cause, errors.BadRequestError):  # of the card's metadata
        remedy = 'correct "license" in the card.json of a checkpoint, in the embodiment of a shard set'
        return HubError(where, f"the hub refuses the card: {shown(str(fault).partition('\n')[2])}", remedy)
    if isinstance(fault, errors.LocalEntryNotFoundError) and isinstance(cause, errors.HfHubHTTPError):
        return explain(where, cause)
    away = errors.OfflineModeIsEnabled | httpx.ConnectError | httpx.TimeoutException
    plain: tuple[tuple[Any, str, str], ...] = (
        (errors.GatedRepoError, "is gated", f"ask for access on its page, then {LOG_IN}"),
        (errors.RevisionNotFoundError, "has no such revision", "name a branch, tag or commit of it"),
        (errors.RepositoryNotFoundError, "no such repository, or no access", f"check the name; {LOG_IN}"),
        (errors.RemoteEntryNotFoundError, "no such file there", "check the name and the revision"),
        (errors.HFValidationError, "is not a repository's name", "write ORGANISATION/NAME"),
        (
            errors.LocalEntryNotFoundError,
            "is out of reach, and not in the cache",
            "check the name, go online",
        ),
        (away, f"is out of reach: {name}", "check the network, try again"),
    )
    for kind, text, remedy in plain:
        if isinstance(fault, kind):
            return HubError(where, text, remedy)
    if isinstance(fault, errors.HfHubHTTPError):
        return _answered(where, fault)
    if isinstance(fault, RuntimeError | ValueError) and isinstance(cause, away | httpx.HTTPError):
        return explain(where, cause)  # the client wraps what a download or an upload raised
    if isinstance(fault, httpx.TransportError) and not isinstance(fault, httpx.UnsupportedProtocol):
        return HubError(where, f"the connection was cut: {name}", RUN_AGAIN)
    if isinstance(fault, OSError) and fault.errno is not None:
        return HubError(where, f"could not be stored: {fault.strerror}", "free space, try again")
    if isinstance(fault, OSError):
        return HubError(where, f"was not transferred completely: {shown(str(fault))}", RUN_AGAIN)
    if isinstance(fault, RuntimeError) and not isinstance(fault, RecursionError):
        remedy = "run it again; HF_HUB_DISABLE_XET=1 may help"  # of the hub's library for transfers
        return HubError(where, f"the transfer failed: {shown(str(fault))}", remedy)
    return HubError(where, f"does not answer like a hub: {name}", "check HF_ENDPOINT and your proxy")


def _answered(where: str, fault: Any) -> HubError:
    request, code = fault.response.request, fault.response.status_code
    if code == 401 and "authorization" not in request.headers:
        return HubError(where, "no such repository, or it is private", "check the name; " + LOG_IN)
    forbidden = "write here: use one with write access to this organisation"
    if request.method in ("GET", "HEAD"):
        forbidden = "read this: ask its owners for access"
    remedies = {
        401: "the token is not valid: " + LOG_IN,
        403: f"the token may not {forbidden}",
        404: "check the name",
        429: "too many requests: wait some minutes and run it again",
    }
    remedy = remedies.get(code, "run the same command again later; nothing there was changed")
    said = shown(getattr(fault, "server_message", None) or "")
    return HubError(where, f"the hub answered {code}" + (f": {said}" if said else ""), remedy)


def status(fault: BaseException) -> int | None:
    """Return the HTTP status that an error came from; None if it came from none."""
    found = _response(fault)
    return None if found is None else int(found.status_code)


def waiting(fault: BaseException, attempt: int) -> float | None:
    """Return the seconds to wait before the next attempt; None if waiting would not help."""
    import httpx

    response = _response(fault)
    if response is None:
        cut = (httpx.RemoteProtocolError, httpx.ReadError, httpx.WriteError)
        return float(2**attempt) if any(isinstance(item, cut) for item in causes(fault)) else None
    if response.status_code not in BUSY:
        return None
    stated = response.headers.get("retry-after", "")
    limit = re.search(r";\s*t\s*=\s*(\d+)", response.headers.get("ratelimit", ""))
    seconds = float(stated) if stated.isdigit() else float(limit[1]) if limit else float(2**attempt)
    return seconds if seconds <= LONGEST_WAIT else None


def is_missing(fault: HubError) -> bool:
    """Check whether a repository does not exist, as far as its hub tells."""
    from huggingface_hub import errors

    # Some hubs answer 404 without the code that states what is missing.
    there = errors.GatedRepoError | errors.RevisionNotFoundError
    missing = isinstance(fault.__cause__, errors.RepositoryNotFoundError) or status(fault) == 404
    return missing and not isinstance(fault.__cause__, there)


def is_away(fault: HubError) -> bool:
    """Check whether the hub is out of reach."""
    import httpx
    from huggingface_hub import errors

    away = errors.OfflineModeIsEnabled | httpx.ConnectError | httpx.TimeoutException
    return isinstance(fault.__cause__, away)


def is_of_xet(fault: BaseException) -> bool:
    """Check whether the hub's library for transfers by Xet failed, and not an HTTP request of the client."""
    import httpx

    chain = list(causes(fault))
    of_library = any(isinstance(item, ConnectionError | TimeoutError | RuntimeError) for item in chain)
    return of_library and not any(isinstance(item, httpx.HTTPError) for item in chain)


def _response(fault: BaseException) -> Any:
    found = (getattr(item, "response", None) for item in causes(fault))
    return next((response for response in found if response is not None), None)


def shown(text: str) -> str:
    """Return text from outside as one short printable line without a token."""
    plain = "".join(c if c.isprintable() else " " for c in text)
    return _hidden(" ".join(plain.split()))[:300]


def _hidden(text: str) -> str:
    from huggingface_hub import get_token

    token = get_token()
    return hidden(text.replace(token, "…") if token else text)

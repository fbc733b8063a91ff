"""The errors of the hub's client as HubErrors: what happened, and what to do. None of them shows a token."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from hma_data.errors import HubError

TRANSIENT = (408, 429, 500, 502, 503, 504)
LOG_IN = "log in with hf auth login, or set HF_TOKEN"
LONGEST_WAIT = 300.0  # seconds; the hub counts requests over five minutes
SILENCE = 300.0  # seconds without an answer; a commit of many files takes the hub minutes


@contextmanager
def explained(where: str) -> Iterator[None]:
    """Raise what the client raises in the block as HubError."""
    try:
        yield
    except HubError:
        raise
    except raised() as fault:
        raise explain(where, fault) from fault


@contextmanager
def bounded() -> Iterator[None]:
    """Let no request of the client in this block wait for ever, which is what it does by default."""
    from huggingface_hub import get_session

    client = get_session()
    before, client.timeout = client.timeout, SILENCE
    try:
        yield
    finally:
        client.timeout = before


def explain(where: str, fault: BaseException) -> HubError:
    """The HubError for an error of the client or of the disk."""
    import httpx
    from huggingface_hub import errors

    cause = fault.__cause__ or fault.__context__
    match fault:
        case errors.GatedRepoError():
            return HubError(where, "is gated", "ask for access on its page, then " + LOG_IN)
        case errors.RevisionNotFoundError():
            return HubError(where, "has no such revision", "name a branch, tag or commit of it")
        case errors.RepositoryNotFoundError():
            return HubError(where, "no such repository, or no access to it", "check the name; " + LOG_IN)
        case errors.RemoteEntryNotFoundError():
            return HubError(where, "no such file there", "check the name and the revision")
        case errors.LocalEntryNotFoundError():
            if isinstance(cause, errors.HfHubHTTPError):
                return explain(where, cause)
            return HubError(where, "is out of reach, and not in the cache", "go online and pull again")
        case errors.HFValidationError():
            return HubError(where, "is not a repository's name", "write ORGANISATION/NAME")
        case errors.HfHubHTTPError():
            return _answered(where, fault)
        case errors.OfflineModeIsEnabled() | httpx.ConnectError() | httpx.TimeoutException():
            name = type(fault).__name__
            return HubError(where, f"is out of reach: {name}", "check the network, try again")
        case httpx.HTTPError():
            fault_text = f"the connection was cut: {type(fault).__name__}"
            return HubError(where, fault_text, "run the same command again; it goes on where it stopped")
        case errors.FileMetadataError():
            return HubError(where, "was not answered by a hub", "check HF_ENDPOINT and your proxy")
    if isinstance(fault, RuntimeError) and cause is not None:  # wraps what went wrong in an upload
        return explain(where, cause)
    return _plain(where, fault)


def waiting(fault: BaseException, attempt: int) -> float | None:
    """Seconds to wait before trying again; None where that would not help."""
    response = getattr(fault, "response", None)
    if response is None:
        return float(2**attempt) if isinstance(fault, cuts()) else None
    if response.status_code not in TRANSIENT:
        return None
    stated = response.headers.get("retry-after", "")
    limit = re.search(r";\s*t\s*=\s*(\d+)", response.headers.get("ratelimit", ""))
    seconds = float(stated) if stated.isdigit() else float(limit[1]) if limit else float(2**attempt)
    return seconds if seconds <= LONGEST_WAIT else None


def cuts() -> tuple[type[BaseException], ...]:
    """What the client raises for a connection that ended too early."""
    import httpx

    return (httpx.RemoteProtocolError, httpx.ReadError, httpx.WriteError)


def raised() -> tuple[type[BaseException], ...]:
    """What the client raises when something goes wrong."""
    import httpx
    from huggingface_hub import errors

    others = (OSError, ValueError, RuntimeError, KeyError, TypeError)
    return (*others, httpx.HTTPError, errors.EntryNotFoundError)


def _answered(where: str, fault: Any) -> HubError:
    response = fault.response
    status = response.status_code if response is not None else None
    if status == 401 and "authorization" not in response.request.headers:
        return HubError(where, "no such repository, or it is private", "check the name; " + LOG_IN)
    remedies = {
        401: "the token is not valid: " + LOG_IN,
        403: "the token may not write here: use one with write access to this organisation",
        404: "check the name",
        413: "a file is too large for the hub",
        429: "too many requests: wait some minutes and run it again",
        507: "the storage of this account is full",
    }
    remedy = remedies.get(status or 0, "try again later; what was there is as it was")
    return HubError(where, f"the hub answered {status}", remedy)


def _plain(where: str, fault: BaseException) -> HubError:
    text = re.sub(r"(?i)\b(hf_|bearer )\w+", r"\1…", " ".join(str(fault).split()))[:300]
    if isinstance(fault, ValueError) and "metadata in README" in text:
        return HubError(where, f"the hub refuses the card: {text}", "correct the licence in embodiment.yaml")
    if isinstance(fault, OSError) and fault.errno is not None:
        return HubError(where, f"could not be stored: {fault.strerror}", "free space, try again")
    if isinstance(fault, OSError):
        return HubError(where, f"did not come whole: {text}", "pull again")
    if isinstance(fault, RuntimeError):  # what the transfer library of the hub raises
        return HubError(where, f"the transfer failed: {text}", "run it again; HF_HUB_DISABLE_XET=1 may help")
    return HubError(where, f"did not answer as a hub does: {type(fault).__name__}", "check HF_ENDPOINT")

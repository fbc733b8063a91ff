"""Uploads to the Hugging Face Hub in chunks (its Xet protocol), or by plain LFS where that does not work.

The client uploads in chunks whenever the library for it is installed, also to a hub that knows nothing of it
and through a firewall that lets none of it pass. Every hub takes files by LFS.
"""

from collections.abc import Sequence
from typing import Any

from hma_data.errors import HubError

TIMEOUT_S = 30.0


def leave_if_unknown(api: Any, repo: str, kind: str) -> None:
    """Let this process upload by plain LFS where the hub knows no uploads in chunks.

    The library for them waits minutes before it says so, or says something else.

    Args:
        api: the client's HfApi.
        repo: organisation/name.
        kind: model or dataset.
    """
    from huggingface_hub import constants, get_session
    from huggingface_hub.utils import build_hf_headers
    from huggingface_hub.utils._runtime import is_xet_available

    if not is_xet_available():
        return
    address = f"{api.endpoint}/api/{kind}s/{repo}/xet-write-token/main"
    headers = build_hf_headers(library_name="hma-toolkit")
    answer = get_session().get(address, headers=headers, timeout=TIMEOUT_S)
    knows = "x-xet-access-token" in answer.headers or b"accessToken" in answer.content
    if answer.status_code in (200, 400, 404, 405, 501) and not knows:
        constants.HF_HUB_DISABLE_XET = True


def refuse_ignored(added: Sequence[Any], where: object) -> None:
    """Raise HubError where a repository's .gitignore would silently leave out what is to be committed.

    Args:
        added: the client's CommitOperationAdds, after their preupload.
    """
    ignored = [item.path_in_repo for item in added if getattr(item, "_should_ignore", False)]
    if ignored:
        fault = f"leaves out {ignored[0]}, by its .gitignore"
        raise HubError(where, fault, "delete that line there, and push again")


def leave_after(fault: BaseException) -> bool:
    """Whether an upload in chunks failed; from then on this process uploads by plain LFS."""
    import httpx
    from huggingface_hub import constants
    from huggingface_hub.utils._runtime import is_xet_available

    of_library = isinstance(fault, ConnectionError | RuntimeError | TimeoutError) or (
        type(fault).__module__.startswith("hf_xet")
    )
    if isinstance(fault, httpx.HTTPError) or not of_library or not is_xet_available():
        return False
    constants.HF_HUB_DISABLE_XET = True
    return True

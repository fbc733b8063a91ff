"""Bounds on what a hub may do to the one who asks: how long it says nothing, how much it says.

The client waits for ever by default, reads answers of any length into memory, and unpacks them, whatever that
makes of them. The bounds hold inside `bounded` alone; outside it the client is as it was.
"""

import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from hma_data.errors import HubError

SILENCE = 300.0  # seconds without an answer; a commit of many files takes the hub minutes
LONGEST_ANSWER = 40_000_000  # bytes of what is not a file; a page of a listing has some 300 kB
LONGEST_REFUSAL = 1_000_000
ROUNDS = 50  # of one address asked for, as by a listing whose next page is the same page
REQUESTS = 5_000
_asked: ContextVar[Counter[str] | None] = ContextVar("asked", default=None)  # None where nothing is bounded


@contextmanager
def bounded() -> Iterator[None]:
    """Let no request in this block wait for ever, nor read a long answer; `downloading` is for files."""
    from huggingface_hub import get_session

    client = get_session()
    hooks = client.event_hooks
    if _limit not in hooks["response"]:  # they do nothing outside such a block, and stay
        client.event_hooks = {
            "request": [*hooks["request"], _ask],
            "response": [*hooks["response"], _limit],
        }
    before, client.timeout = client.timeout, SILENCE
    mark = _asked.set(Counter())
    try:
        yield
    finally:
        _asked.reset(mark)
        client.timeout = before


@contextmanager
def downloading() -> Iterator[None]:
    """What comes in this block goes to a file, and whoever writes it looks after its length."""
    mark = _asked.set(None)
    try:
        yield
    finally:
        _asked.reset(mark)


def _ask(request: Any) -> None:
    asked = _asked.get()
    if asked is None:
        return
    request.headers["Accept-Encoding"] = "gzip"  # which can be unpacked piece by piece
    address = str(request.url) if request.method == "GET" else ""
    asked.update({"": 1} | ({address: 1} if address else {}))
    if asked[address] > (ROUNDS if address else REQUESTS) or asked[""] > REQUESTS:
        raise _fault(request, "sends the one who asks in circles")


def _limit(response: Any) -> None:
    plain = response.is_success and not response.has_redirect_location
    if plain and _asked.get() is None:
        return
    most = LONGEST_ANSWER if plain else LONGEST_REFUSAL
    packed = response.headers.get("Content-Encoding", "identity").lower()
    if packed not in ("identity", "", "gzip"):
        raise _fault(response.request, f"answers in {packed[:20]!r}, which was not asked for")
    if packed == "gzip":
        del response.headers["Content-Encoding"]  # or it would be unpacked twice
    response.stream = _cut(response, most, packed == "gzip")


def _cut(response: Any, most: int, packed: bool) -> Any:
    """The response's stream, unpacked, which ends in an error after so many bytes."""
    import httpx

    inner = response.stream

    class Cut(httpx.SyncByteStream):
        def __iter__(self) -> Iterator[bytes]:
            unpack = zlib.decompressobj(wbits=31) if packed else None
            left = most
            for block in inner:
                try:
                    made = unpack.decompress(block, left + 1) if unpack else block
                except zlib.error as fault:
                    raise _fault(response.request, "answers with damaged gzip") from fault
                left -= len(made)
                if left < 0:
                    raise _fault(response.request, f"answers with more than {most:,} bytes")
                yield made

        def close(self) -> None:
            inner.close()

    return Cut()


def _fault(request: Any, fault: str) -> HubError:
    address = str(request.url.copy_with(query=None))
    return HubError(address, fault, "do not use this repository, or check HF_ENDPOINT and your proxy")

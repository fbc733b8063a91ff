"""Whether a store can be reached at all: asked once, before anything else is asked of it.

A driver tries a wrong address again and again, for most of a minute, as if a busy store were behind it.
So before the first request this process connects to the store's address itself. A store that was reached
once keeps all patience, and so do processes that this one started: it was reached before they were.
"""

import logging
import multiprocessing
import socket
import time
from typing import Any
from urllib.parse import urlsplit
from urllib.request import getproxies, proxy_bypass

from hma_data.errors import StorageAwayError

WAITS_S = (0.5, 1.0)  # before the second and third try
CONNECT_S = 2.5
PORTS = {"http": 80, "https": 443}
_reached: set[str] = set()

log = logging.getLogger(__name__)


def reach(files: Any, where: object) -> None:
    """Connect to a store that was not reached before; nothing is sent.

    Args:
        files: its fsspec file system. Where the address is not known or lies behind a proxy, nothing is done.
        where: the URI, for the error.

    Raises:
        StorageAwayError: its name is unknown, or nobody answers there.
    """
    if multiprocessing.parent_process() is not None:
        return
    url = address(files, where)
    if not url or url in _reached:
        return
    host, port = _host_and_port(url)
    fault = None if _is_behind_a_proxy(url, host) else _tried(host, port)
    if fault:
        setting = "" if str(where).startswith(url) else " in your settings (AWS_ENDPOINT_URL for s3)"
        raise StorageAwayError(
            where,
            f"cannot be reached: {host}:{port}: {fault.strerror or fault or type(fault).__name__}",
            f"check the network, and the address{setting}",
        ) from fault
    _reached.add(url)


def address(files: Any, where: object) -> str:
    """Scheme, host and port of the server that a file system asks, as a URL; empty where it does not tell."""
    kinds = {files.protocol} if isinstance(files.protocol, str) else set(files.protocol)
    if kinds & {"http", "https"}:
        url = str(where)
    elif "s3" in kinds:
        if getattr(files, "config_kwargs", {}).get("proxies"):
            return ""
        url = str(files.s3.meta.endpoint_url)
    elif "gs" in kinds:
        url = str(getattr(files, "_location", ""))
    else:
        return ""
    try:
        parts = urlsplit(url)
        known = parts.scheme in PORTS and parts.hostname and parts.port != 0
    except ValueError:  # the driver will say what is wrong with it
        return ""
    return f"{parts.scheme}://{parts.netloc}" if known else ""


def _host_and_port(url: str) -> tuple[str, int]:
    parts = urlsplit(url)
    return parts.hostname or "", parts.port or PORTS[parts.scheme]


def _is_behind_a_proxy(url: str, host: str) -> bool:
    proxies = getproxies()
    return bool({urlsplit(url).scheme, "all"} & set(proxies)) and not proxy_bypass(host)


def _tried(host: str, port: int) -> OSError | None:
    """What hindered the last of several connections; None once there was one."""
    for wait_s in (*WAITS_S, None):
        fault = _fault(host, port)
        if fault is None or wait_s is None:
            return fault
        log.info("%s:%d: %s; trying again", host, port, fault)
        time.sleep(wait_s)
    raise AssertionError("the last try returns")


def _fault(host: str, port: int) -> OSError | None:
    """What hinders a connection; of many addresses the first of each kind is tried."""
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as fault:
        return fault if isinstance(fault, OSError) else OSError(0, f"no name of a host: {fault}")
    last: OSError = OSError(0, "it has no address")
    for address in {str(kind): str(place[0]) for kind, *_, place in reversed(found)}.values():
        try:
            socket.create_connection((address, port), timeout=CONNECT_S).close()
            return None
        except OSError as fault:
            last = fault
    return last

"""Run an iterator in a thread, a few items ahead of whoever uses it."""

from collections.abc import Iterable, Iterator
from queue import Queue
from threading import Event, Thread


def prefetch[T](items: Iterable[T], depth: int = 2) -> Iterator[T]:
    """The same items in the same order; errors surface where the item would have.

    Args:
        items: used in the thread only.
        depth: how many may wait.
    """
    queue: Queue[tuple[str, T | BaseException | None]] = Queue(maxsize=depth)
    stop = Event()

    def produce() -> None:
        try:
            for item in items:
                queue.put(("item", item))
                if stop.is_set():
                    return
            queue.put(("end", None))
        except BaseException as fault:  # handed over, not handled
            queue.put(("fault", fault))

    thread = Thread(target=produce, daemon=True)
    thread.start()
    try:
        while True:
            kind, value = queue.get()
            if kind == "end":
                return
            if kind == "fault":
                assert isinstance(value, BaseException)
                raise value
            yield value  # type: ignore[misc]
    finally:
        stop.set()
        while thread.is_alive():  # the thread may be waiting to put one more
            while not queue.empty():
                queue.get_nowait()
            thread.join(timeout=0.05)

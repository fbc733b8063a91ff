"""Run benchmarks: `hma bench NAME [key=value …]`. Input is generated; nothing is downloaded."""

import os
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hma_data.cpu import usable_cores
from hma_data.errors import UsageError

if TYPE_CHECKING:
    from hma_data.registry.embodiment import Embodiment

BENCHES: dict[str, str] = {  # name -> module of this folder:object
    "convert": "convert:BENCH",
    "drift": "drift:BENCH",
    "holds": "holds:BENCH",
    "generate": "generation:GENERATE",
    "lerobot": "sources:LEROBOT",
    "loader": "loader:BENCH",
    "mup": "mup:BENCH",
    "page": "page:BENCH",
    "play": "play:BENCH",
    "quality": "quality:BENCH",
    "scale": "scale:BENCH",
    "sources": "sources:BENCH",
    "train": "speed:TRAIN",
    "waiting": "waiting:WAITING",
}


@dataclass(frozen=True)
class Bench:
    """A benchmark.

    Attributes:
        about: one line.
        defaults: its settings.
        run: takes the settings; returns one mapping for each case: the values that distinguish the case, and
            the figures, each named with its unit (`frames_per_second`, `peak_rss_mib`).
        choices: what some settings, or the items of some lists, must be one of.
        zeros: settings that may be 0 though their default is not.
        fault: takes these mappings, and returns what is wrong with them, or nothing; with a fault
            `hma bench` exits 1.
    """

    about: str
    defaults: dict[str, Any]
    run: Callable[[dict[str, Any]], list[dict[str, Any]]]
    fault: Callable[[list[dict[str, Any]]], str] = lambda rows: ""
    choices: dict[str, tuple[str, ...]] = field(default_factory=dict)
    zeros: tuple[str, ...] = ()


def load(name: str) -> Bench:
    """Return a benchmark; raise UsageError if there is no such benchmark."""
    if name not in BENCHES:
        known = ", ".join(sorted(BENCHES))
        raise UsageError(f"benchmark {name!r}", "does not exist", f"known: {known}")
    module, _, entry = BENCHES[name].partition(":")
    return getattr(import_module(f"recipes.bench.{module}"), entry)


def settings_of(bench: Bench, name: str, overrides: Sequence[str]) -> dict[str, Any]:
    """Return the defaults changed by `key=value` words; each value has the type of its default.

    No number is negative, and none is 0 unless its default is.

    Raises:
        UsageError: there is no such setting, or a value is not allowed.
    """
    from hma_data.storage.yaml_io import parse_yaml

    settings = dict(bench.defaults)
    for word in overrides:
        key, given, text = word.partition("=")
        if not given or key not in settings:
            raise UsageError(f"bench {name}: {word}", "is not a setting", f"settings: {', '.join(settings)}")
        value = parse_yaml(text, f"bench {name}: {key}", UsageError)
        kind = type(settings[key])
        if kind is float and type(value) is int:
            value = float(value)
        if type(value) is not kind and settings[key] is not None:
            listed = f"[{', '.join(map(str, settings[key] or ['NAME']))}]" if kind is list else ""
            raise UsageError(
                f"bench {name}: {word}", f"must be {kind.__name__}, like {listed or settings[key]}"
            )
        _check_range(f"bench {name}: {word}", value, zero=not settings[key] or key in ("seed", *bench.zeros))
        known = bench.choices.get(key)
        unknown = [one for one in (value if kind is list else [value]) if known and one not in known]
        if known and unknown:
            raise UsageError(
                f"bench {name}: {key}", f"{unknown[0]!r} is unknown", f"known: {', '.join(known)}"
            )
        settings[key] = value
    return settings


def _check_range(where: str, value: Any, zero: bool) -> None:
    if (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and not (value > 0 or (value == 0 and zero))
    ):
        raise UsageError(where, "is too small", f"give {'0 or more' if zero else 'more than 0'}")


def report(name: str, settings: dict[str, Any], results: list[dict[str, Any]]) -> dict[str, Any]:
    """Return what `--json` prints: the figures, and the machine on which they were measured."""
    models = _values_of("/proc/cpuinfo", "model name")
    machine = {
        "processor": models[0] if models else platform.processor() or platform.machine(),
        "cores": usable_cores(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "system": platform.platform(terse=True),
        "python": platform.python_version(),
        "load_average": round(os.getloadavg()[0], 2),
        "date": time.strftime("%Y-%m-%d"),
    }
    return {"bench": name, "machine": machine, "settings": settings, "results": results}


def peak_rss_mib() -> float:
    """Return the most memory this process has held, in MiB, without what its parent held before."""
    import resource

    peaks = _values_of("/proc/self/status", "VmHWM")
    kib = int(peaks[0].split()[0]) if peaks else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(kib / 1024, 1)


def rss_mib(pid: int | str = "self") -> float:
    """Return the resident memory of a process in MiB; 0 if it has ended, or without Linux's /proc."""
    sizes = _values_of(f"/proc/{pid}/status", "VmRSS")
    return int(sizes[0].split()[0]) / 1024 if sizes else 0.0


def _values_of(path: str, key: str) -> list[str]:
    """Return the values of a key in a file of `key: value` lines; none if there is no such file."""
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
    return [line.partition(":")[2].strip() for line in lines if line.startswith(key)]


def in_fresh_process[T](task: Callable[..., T], *arguments: Any) -> T:
    """Return the task's result, computed in a new process where nothing has taken memory yet."""
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as fresh:
        return fresh.submit(task, *arguments).result()


def make_robot(
    id: str, format: str, action: str, camera: str, /, hz: int = 10, dims: int = 7, **values: Any
) -> "Embodiment":
    """Return an embodiment of one camera, `main`; `values` are further top-level keys of its YAML."""
    from hma_data.registry.embodiment import Embodiment

    usual = {
        "id": id, "kind": "simulation", "frequency_hz": hz, "source": {"format": format},
        "action": {"space": "joint_delta", "components": [{"key": action, "dims": dims}]},
        "cameras": [{"name": "main", "key": camera}],
    }  # fmt: skip
    return Embodiment.from_values(usual | values, id)

"""Choose episodes by id, by glob, or by a file of ids.

A word of `only` or `exclude` is the id of an episode, a glob such as `night_*` (`*` also stands for a slash),
or `@FILE`: a file with one id or glob a line, in which empty lines and lines that begin with # do not count.
"""

from collections.abc import Iterator, Sequence
from fnmatch import filter as matching
from pathlib import Path

from hma_data.errors import HMAError, RegistryError, UsageError, meant
from hma_data.registry.embodiment import Embodiment

MAX_NAMES = 3  # ids named in an error


def chosen_ids(
    ids: Sequence[str], only: Sequence[str], exclude: Sequence[str], where: str = "--"
) -> list[str]:
    """Return the ids that `only` names (all of them where it is empty), without those that `exclude` names.

    Args:
        ids: of all episodes.
        where: what an error puts before `only` and `exclude`: "--", or the YAML's place.

    Raises:
        UsageError: a word matches no episode, or none is left (RegistryError where a YAML says so).
    """
    error = UsageError if where == "--" else RegistryError
    known = dict.fromkeys(ids)
    taken = _named(known, only, f"{where}only", error) if only else set(known)
    taken = taken - _named(known, exclude, f"{where}exclude", error)
    left = [name for name in ids if name in taken]
    if ids and not left:
        raise error(f"{where}{'exclude' if exclude else 'only'}", f"leaves none of {len(ids):,} episodes")
    return left


def ids_for_robot(ids: Sequence[str], robot: Embodiment) -> list[str]:
    """Return the ids that `source.only` and `source.exclude` of an embodiment's YAML choose."""
    where = f"embodiment {robot.id}: source."
    return chosen_ids(ids, robot.source.only, robot.source.exclude, where)


def _named(known: dict[str, None], words: Sequence[str], where: str, error: type[HMAError]) -> set[str]:
    """Return the ids that the words name, each by its own name or by a glob."""
    found: set[str] = set()
    for word, said in _lines(words, where, error):
        ids = [word] if word in known else matching(known, word)
        if not ids:
            some = f"there are ids such as {', '.join(list(known)[:MAX_NAMES])}"
            raise error(where, f"{said} matches no episode", meant(word, known, 1) or some)
        found.update(ids)
    return found


def _lines(words: Sequence[str], where: str, error: type[HMAError]) -> Iterator[tuple[str, str]]:
    """Yield each id or glob, and what an error calls it; open the files."""
    for word in words:
        if not word.startswith("@"):
            yield word, repr(word)
            continue
        try:
            lines = Path(word[1:]).expanduser().read_text("utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as fault:
            reason = getattr(fault, "strerror", None) or fault
            raise error(where, f"{word[1:]} cannot be read: {reason}", "name a text file of ids") from fault
        for number, line in enumerate(lines, 1):
            if line.strip() and not line.startswith("#"):
                yield line.strip(), f"{line.strip()!r} in line {number} of {word[1:]}"

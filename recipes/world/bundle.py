"""Put a trained network into the package as hma_model/NAME, with weights in float16.

    python recipes/world/bundle.py RUN embedded-lab                 # or some of its robots: -e mover_10 …
    python recipes/world/bundle.py embedded-lab embedded-lab        # one that is there, anew

Cards keep what they say. A new robot gets a sample image from the run's shards; then its verdicts come from
recipes/bench/verdicts.py and meters.py and from `hma bench holds record=true`, its time from holding.py.
"""

import argparse
import json
import shutil
import tempfile
from pathlib import Path

import hma_model
import hma_model.play
from hma_data.console import run_script
from hma_data.storage.files import write_atomic
from hma_model.checkpoint import io
from hma_model.checkpoint.folder import FILM, SAMPLE, Checkpoint
from hma_model.hub.sample import add_samples, at_hand
from hma_model.play.holding import MEASURED


def main() -> None:
    """Write the checkpoint beside its place, then put it there."""
    parser = argparse.ArgumentParser(description="Put a trained network into the package")
    parser.add_argument("checkpoint")
    parser.add_argument("name")
    parser.add_argument("-e", "--embodiments", nargs="+")
    given = parser.parse_args()
    source = Checkpoint.open(given.checkpoint)
    robots, place = source.chosen(given.embodiments), Path(hma_model.__file__).parent / given.name
    with tempfile.TemporaryDirectory() as made:
        new = io.save(
            io.load(source, robots),
            Path(made) / given.name,
            embodiment_yaml={one: source.embodiment(one).to_yaml() for one in robots},
            stats={one: dict(source.stats(one)) for one in robots},
            cards={one: source.card(one) for one in robots},
            samples={
                one: source.path(one, SAMPLE).read_bytes() for one in robots if SAMPLE in source.pictures(one)
            },
            half=True,
        )
        if not source.bundled:
            add_samples(new, at_hand(source, robots))
            for film in new.folder.rglob(FILM):  # as large as the network
                film.unlink()
            io.write_readme(new)
        known = Path(hma_model.play.__file__).parent / MEASURED
        times = json.loads(known.read_text())
        if source.trunk_sha256 in times:
            moved = {new.trunk_sha256: times.pop(source.trunk_sha256)}
            write_atomic(known, json.dumps(times | moved, indent=1) + "\n")
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(new.folder, place)
    size = sum(file.stat().st_size for file in place.rglob("*") if file.is_file())
    print(f"{place}: {', '.join(robots)}; {size / 1e6:.1f} MB")


if __name__ == "__main__":
    run_script(main)

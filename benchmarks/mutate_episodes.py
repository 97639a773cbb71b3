"""Give damaged copies of an episode to the commands: each must end with a code and a reason.

    python benchmarks/mutate_episodes.py RUN EPISODE 1000 info check recover evaluate replay

Mutations are cuts, bit flips, zeroed pages, swapped blocks, and, for what checksums do not see,
bits flipped within messages whose checksums are then made right again. A command fails the test
when it ends with a traceback, with a code that docs/cli.md does not know, or without a word.
"""

import contextlib
import io
import json
import random
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import robot_gst
from bridge.episode.mcap.file import McapFile
from bridge.episode.mcap.messages import Selection, merged
from bridge.episode.reader import Episode
from bridge.episode.schema import Schema
from bridge.episode.writer import EpisodeWriter

CODES = {0, 1, 2, 3}
PAGE, SEED = 4096, 1
STRANGE = ("", "null", "[]", "{}", "-1", '"x"', "1e999", "NaN", "[[[[")
"""Values of metadata."""
MAX_IMAGES = 4
"""Of each image topic in the copy: what is between says nothing new."""
ARGUMENTS = {
    "info": ["{episode}"],
    "check": ["{episode}"],
    "recover": ["{episode}"],
    "ls": ["{run}"],
    "export": ["csv", "{episode}", "{out}"],
    "evaluate": ["{run}", "--out", "{out}"],
    "replay": ["{run}", "--workers", "1"],
}


def thin(path: Path, to: Path, flip: random.Random | None = None) -> None:
    """Copy an episode with few images; with ``flip`` one message has a few other bits."""
    episode = Episode.open(path)
    seen: Counter[str] = Counter()
    items = []
    for item in merged(episode.files, Selection(None)):
        seen[item.channel.topic] += 1
        if len(item.data) < 20_000 or seen[item.channel.topic] <= MAX_IMAGES:
            items.append(item)
    hit = -1 if flip is None else flip.randrange(len(items))
    with EpisodeWriter(to) as writer:
        for number, item in enumerate(items):
            record = item.file.schema_of(item.channel)
            data = item.data
            if number == hit and flip is not None:
                data = flipped(data, flip)
            writer.write_foreign(
                item.channel.topic,
                data,
                schema_record=None
                if record is None
                else Schema(
                    name=record.name,
                    schema_encoding=record.encoding,
                    message_encoding=item.channel.message_encoding,
                    data=record.data,
                ),
                message_encoding=item.channel.message_encoding,
                log_time_ns=item.log_time_ns,
                publish_time_ns=item.publish_time_ns,
                sequence=item.sequence,
            )
        for file in episode.files:
            _add_metadata(writer, file, flip if hit >= 0 and flip and flip.random() < 0.2 else None)


def _add_metadata(writer: EpisodeWriter, file: McapFile, flip: random.Random | None) -> None:
    records = list(file.metadata)
    hit = -1 if flip is None else flip.randrange(len(records))
    for number, record in enumerate(records):
        values = dict(record.metadata)
        if number == hit and flip is not None and values:
            name = flip.choice(sorted(values))
            values[name] = flip.choice((*STRANGE, values[name][:-1], "9" * 400))
        writer.add_metadata(record.name, values)


def flipped(data: bytes, rng: random.Random) -> bytes:
    """Change a few bits, or the length."""
    out = bytearray(data)
    if not out:
        return b"\xff"
    kind = rng.randrange(4)
    if kind == 0:
        return bytes(out[: rng.randrange(len(out))])
    for _ in range(1 if kind == 1 else rng.randrange(1, 20)):
        out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Damage a file as disks, copies and crashes do."""
    out = bytearray(data)
    kind = rng.randrange(6)
    if kind == 0:
        del out[rng.randrange(len(out)) :]
    elif kind == 1:
        for _ in range(rng.choice((1, 1, 3, 30))):
            out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    elif kind == 2:
        at = rng.randrange(len(out)) // PAGE * PAGE
        out[at : at + PAGE] = bytes(len(out[at : at + PAGE]))
    elif kind == 3:
        first, second = sorted(rng.randrange(len(out)) for _ in range(2))
        out[first : first + 300], out[second : second + 300] = (
            out[second : second + 300],
            out[first : first + 300],
        )
    elif kind == 4:  # the summary and the footer, on which all readers lean
        at = len(out) - rng.randrange(1, min(len(out), 20_000))
        out[at] ^= 1 << rng.randrange(8)
    else:
        out += bytes(rng.randrange(256) for _ in range(rng.randrange(1, 500)))
    return bytes(out)


def mutants(path: Path, folder: Path, count: int, seed: int) -> Iterator[bytes]:
    """Yield damaged copies: two thirds broken files, one third broken content."""
    whole = folder / "whole.mcap"
    thin(path, whole)
    data = whole.read_bytes()
    for number in range(count):
        rng = random.Random(seed * 1_000_003 + number)
        if number % 3:
            yield damaged(data, rng)
            continue
        made = folder / "made.mcap"
        made.unlink(missing_ok=True)
        thin(whole, made, rng)
        yield made.read_bytes()


def run_command(name: str, arguments: list[str]) -> tuple[int | None, str]:
    """Run a command in this process; the code is None after a traceback."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
            return robot_gst.run([name, *arguments]), said.getvalue()
    except BaseException:  # noqa: BLE001  # what we look for
        return None, f"{said.getvalue()}\n{traceback.format_exc()}"


class Trial:
    """A copy of a run with one episode, which is damaged again and again."""

    def __init__(self, source: Path, episode_id: str, folder: Path) -> None:
        """Copy the run without its other episodes, results and caches."""
        self.folder = folder
        self.run = folder / "run"
        left_out = shutil.ignore_patterns("results", "*.views.*", "*.sqlite")
        shutil.copytree(source, self.run, ignore=left_out)
        self.target = self.run / "episodes" / f"{episode_id}.mcap"
        self.original = folder / "original.mcap"
        shutil.copy(self.target, self.original)
        self.codes: Counter[tuple[str, int | None]] = Counter()
        self.failures: list[str] = []
        self._clear(self.target)

    def _clear(self, kept: Path) -> None:
        for left in (self.run / "episodes").glob("*"):
            if left != kept:
                left.unlink()
        shutil.rmtree(self.folder / "out", ignore_errors=True)
        shutil.rmtree(self.run / "results", ignore_errors=True)

    def give(self, name: str, data: bytes, commands: list[str]) -> None:
        """Give one damaged copy to each command."""
        for command in commands:
            self.target.write_bytes(data)
            self._clear(self.target)
            values = {"run": self.run, "episode": self.target, "out": self.folder / "out"}
            arguments = [text.format(**values) for text in ARGUMENTS[command]]
            code, text = run_command(command, arguments)
            self.codes[command, code] += 1
            is_mute = code in (1, 2) and not text.strip()
            if code not in CODES or "Traceback" in text or is_mute:
                self.failures.append(f"{command}, {name}: {code}\n{text[-3000:]}")


def main() -> int:
    """Run, and print what went wrong."""
    source, episode_id, count = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
    commands = sys.argv[4:] or ["info", "check"]
    begun_s = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        trial = Trial(source, episode_id, Path(folder))
        for number, data in enumerate(mutants(trial.original, Path(folder), count, SEED)):
            before = len(trial.failures)
            trial.give(f"mutant {number}", data, commands)
            for failure in trial.failures[before:]:
                print(failure, flush=True)
    codes = {f"{name} {code}": n for (name, code), n in sorted(trial.codes.items(), key=str)}
    print(json.dumps({"mutants": count, "codes": codes, "failures": len(trial.failures)}))
    print(f"{time.process_time() - begun_s:.0f} s CPU")
    return 1 if trial.failures else 0


if __name__ == "__main__":
    sys.exit(main())

"""Write down what a checkout makes of stored inputs, so that two versions can be held together.

    python tests/golden/house/make_goldens.py CHECKOUT OUT [--only help,demo]
    python tests/golden/house/make_goldens.py CHECKOUT --inputs RUN

The second line makes the inputs once, with the version before the change: a copy of RUN (a finished
run of the demo), the imported Kinova runs, an invented run with soft objects, the kitchen, damaged
files. They lie in ``inputs`` below the folder that GST_GOLDENS names, outside git, and are never
written to. The first line runs CHECKOUT's commands on copies of them and writes one JSON file of
facts for each group into OUT. Everything has fixed seeds, one thread and ``--iterations``.

Left out because no two runs agree on it: paths, wall time and memory (``TIMES``), the version
of the code, and digests of settings (``DIGESTS``), which change with the code by design.
"""

import argparse
import hashlib
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mcap.exceptions import McapError
from mcap.reader import make_reader

HERE = Path(__file__).resolve().parent
FOLDER = Path(os.environ.get("GST_GOLDENS", "goldens")).resolve()
INPUTS = FOLDER / "inputs"
DATA = Path(os.environ.get("GST_SHARED_DATA", HERE.parents[3] / "shared/data"))
KITCHEN, KINOVA = DATA / "rgbd_7scenes_redkitchen_a", DATA / "robot_realitygap_kinova_real_vs_sim"

REPLAYED = ("trial_0001", "trial_0010", "trial_0013", "trial_0016")
"""Of the demo: both tasks, both policies, without and with replanning."""
KINOVA_TAKEN = ("single_0001", "single_0002", "cubeexp_0001", "cubeexp_0003")
FIT = ("--iterations", "60", "--max-splats", "20000", "--max-train-frames", "30")
FIT += ("--max-holdout-frames", "4", "--threads", "1")

DIGESTS = {
    *("scene_hash", "settings_hash", "config_hash", "task_sha256", "software", "provenance"),
    *("git_commit", "version", "sha256", "source_sha256", "calibration_id", "config", "settings"),
    "key",
}
TIMES = re.compile(r"^(cpu_)?seconds$|_wall_s$|^wall_s$|^stages_s$|^peak_memory_mb$|^elapsed")
HASH_IN_NAME = re.compile(r"([._/])[0-9a-f]{8,64}(?=$|[._/\s),:\"'])")
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
Facts = dict[str, Any]


class Checkout:
    """Runs the commands of one version of the project, in a working folder of its own."""

    def __init__(self, root: Path, work: Path) -> None:
        """Remember where it lies."""
        self.root, self.work = root.resolve(), work

    def python(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run its interpreter from its root, with one thread and a plain terminal."""
        path = os.pathsep.join([str(self.root), str(self.root / "tests" / "golden")])
        fixed = {"PYTHONHASHSEED": "0", "COLUMNS": "120", "NO_COLOR": "1", "PYTHONPATH": path}
        return subprocess.run(
            [str(self.root / ".venv/bin/python"), *arguments],
            capture_output=True,
            text=True,
            check=False,
            cwd=self.work,
            env={**os.environ, **ONE_THREAD, **fixed},
        )

    def gst(self, *arguments: str | Path) -> Facts:
        """Run one command; its exit code, and what it prints: as JSON where it is JSON."""
        began = time.monotonic()
        done = self.python("-m", "robot_gst", *map(str, arguments))
        print(f"  {time.monotonic() - began:5.1f} s  {' '.join(map(str, arguments))[:100]}")
        if done.returncode not in (0, 1, 3):
            print(done.stderr[-2000:], file=sys.stderr)
        return self.said(done.returncode, done.stdout)

    def many(self, lines: Sequence[Sequence[str | Path]]) -> list[Facts]:
        """Run several commands in one process, which loads libraries once."""
        code = (
            "import contextlib, io, json, sys, robot_gst\n"
            "found = []\n"
            "for line in json.loads(sys.argv[1]):\n"
            "    with contextlib.redirect_stdout(io.StringIO()) as text:\n"
            "        found.append([robot_gst.run(line), text.getvalue()])\n"
            "print(json.dumps(found))"
        )
        done = self.python("-c", code, json.dumps([[str(word) for word in line] for line in lines]))
        if done.returncode:
            sys.exit(done.stderr[-2000:])
        return [self.said(exit_code, text) for exit_code, text in json.loads(done.stdout)]

    def said(self, exit_code: int, text: str) -> Facts:
        """An exit code, and what was printed where it is JSON."""
        try:
            return {"exit": exit_code, "json": self.plain(json.loads(text))}
        except ValueError:
            return {"exit": exit_code, "json": None}

    def plain(self, value: Any) -> Any:
        """A value without digests, times and paths of this machine."""
        if isinstance(value, dict):
            return {
                self.plain(key): self.plain(item)
                for key, item in value.items()
                if key not in DIGESTS and not TIMES.search(key)
            }
        if isinstance(value, list):
            return [self.plain(item) for item in value]
        if isinstance(value, str):
            for path, name in ((self.work, "WORK"), (DATA, "DATA"), (INPUTS, "INPUTS")):
                value = value.replace(str(path), name)
            return HASH_IN_NAME.sub(r"\1HASH", value.replace(str(self.root), "CHECKOUT"))
        return value


def digest(data: bytes) -> str:
    """The first half of the SHA-256 of some bytes."""
    return hashlib.sha256(data).hexdigest()[:32]


def by_name(found: Sequence[tuple[str, Any]]) -> Facts:
    """Facts by name; where several have one, in the order of what they say."""
    facts: Facts = {}
    for name, fact in sorted(found, key=lambda each: (each[0], json.dumps(each[1]))):
        number = sum(other.split("#")[0] == name for other in facts)
        facts[f"{name}#{number + 1}" if number else name] = fact
    return facts


def by_file(said: Facts) -> Facts:
    """What ``check --json`` says of each file, by its path without slashes."""
    files = (said["json"] or {}).get("episodes", [])
    return {"exit": said["exit"]} | {each["file"].replace("/", "|"): each for each in files}


def episode_facts(checkout: Checkout, path: Path) -> Facts:
    """Messages of each topic, a digest of their payloads, and short JSON payloads as they are."""
    payloads: dict[str, list[bytes]] = {}
    with path.open("rb") as stream:
        try:
            for _, channel, message in make_reader(stream).iter_messages(log_time_order=True):
                data = message.data
                if channel.message_encoding == "json":
                    value = checkout.plain(json.loads(data))
                    data = json.dumps(value, sort_keys=True).encode()
                payloads.setdefault(channel.topic, []).append(data)
        except (McapError, ValueError) as error:
            return {"unreadable": type(error).__name__}
    facts: Facts = {}
    for topic, datas in payloads.items():
        facts[topic] = {"messages": len(datas), "payloads": digest(b"\0".join(datas))}
        if "verdict" in topic and len(datas) == 1:
            facts[topic]["said"] = json.loads(datas[0])
    return facts


def run_facts(checkout: Checkout, run: Path) -> Facts:
    """What a run folder holds: derived episodes, vertices of PLY files, numbers of the scene."""
    derived = [(path.stem, path) for path in sorted(run.glob("derived/*.mcap"))]
    facts: Facts = {
        "derived": by_name(
            [(checkout.plain(f"{name}."), episode_facts(checkout, path)) for name, path in derived]
        )
    }
    for path in sorted(run.glob("scene/**/*.ply")):
        head, _, body = path.read_bytes().partition(b"end_header\n")
        count = re.search(rb"element vertex (\d+)", head)
        vertices = int(count[1]) if count else None
        name = str(path.relative_to(run))
        facts.setdefault("ply", {})[name] = {"vertices": vertices, "body": digest(body)}
    for name in ("scene.json", "calibration.json"):
        if (run / "scene" / name).is_file():
            facts[name] = checkout.plain(json.loads((run / "scene" / name).read_text()))
    return facts


def results_facts(checkout: Checkout, folder: Path) -> Facts:
    """Every number of an evaluation: measurements by id, tables by id, what was left out."""
    path = folder / "results.json"
    if not path.is_file():
        return {"results": None}
    results = json.loads(path.read_text())
    kept = ("value", "unit", "k", "n", "counted", "interval", "reason_if_undefined")
    measurements = {
        checkout.plain(each["id"]): {key: checkout.plain(each.get(key)) for key in kept}
        for each in results["measurements"]
    }
    tables = {
        each["id"]: {
            "rows": [
                dict(zip(each["columns"], checkout.plain(row), strict=True)) for row in each["rows"]
            ]
        }
        for each in results["tables"]
    }
    files = [each for each in folder.rglob("*") if each.is_file() and "cache" not in each.parts]
    return {
        "measurements": measurements,
        "tables": tables,
        "exclusions": by_name(
            [
                (f"{each['episode']}: {each['scope']}", each["reason"])
                for each in results["exclusions"]
            ]
        ),
        "missing": dict.fromkeys(checkout.plain(results["missing"]), True),
        "stand_in": results["stand_in"],
        "files": len(files),
    }


def copied(checkout: Checkout, name: str, *parts: str) -> Path:
    """A copy of an input, or of some of its parts, to work in."""
    target = checkout.work / name
    shutil.rmtree(target, ignore_errors=True)
    for part in parts or (".",):
        source = INPUTS / name / part
        if source.is_dir():
            shutil.copytree(source, target / part, dirs_exist_ok=True)
        else:
            (target / part).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target / part)
    return target


def help_texts(checkout: Checkout) -> Facts:
    """The help of every command that is shown, and the names of its flags."""
    code = (
        "import contextlib, io, json, robot_gst\n"
        "def walk(app, path):\n"
        "    yield path\n"
        "    for name in [n for n in app if not n.startswith('-') and app[n].show]:\n"
        "        yield from walk(app[name], [*path, name])\n"
        "texts = {}\n"
        "for path in walk(robot_gst.build_app(), []):\n"
        "    with contextlib.redirect_stdout(io.StringIO()) as text:\n"
        "        robot_gst.run([*path, '--help'])\n"
        "    texts[' '.join(['robot-gst', *path])] = text.getvalue()\n"
        "print(json.dumps(texts))"
    )
    done = checkout.python("-c", code)
    if done.returncode:
        sys.exit(done.stderr)
    facts: Facts = {}
    for name, text in json.loads(done.stdout).items():
        rows = [line.strip("│ ") for line in text.splitlines() if line.startswith("│")]
        flags = sorted(
            {flag for row in rows for flag in re.findall(r"(?:^|\s)(--[\w.-]+)", row[:45])}
        )
        facts[name] = {"flags": dict.fromkeys(flags, True), "text": text.splitlines()}
    return facts


def demo(checkout: Checkout) -> Facts:
    """The stored run of the demo: listed, checked, evaluated."""
    run = copied(checkout, "demo", "episodes", "derived", "scene", "tasks")
    some = [each for name in REPLAYED for each in sorted(run.rglob(f"{name}*.mcap"))]
    said = checkout.gst("check", run / "episodes/scan_0001.mcap", *some, "--json")
    facts = {"ls": checkout.gst("ls", run, "--json"), "check": by_file(said)}
    facts["evaluate"] = {"exit": checkout.gst("evaluate", run, "--quiet")["exit"]}
    return facts | results_facts(checkout, run / "results")


def replays(checkout: Checkout) -> Facts:
    """Some of the demo's trials, localised and replayed anew in the stored scene."""
    episodes = [f"episodes/{name}.mcap" for name in ("scan_0001", *REPLAYED)]
    run = copied(checkout, "demo", *episodes, "scene", "tasks")
    chosen = [word for name in REPLAYED for word in ("--episode", name)]
    done = checkout.gst("replay", run, *chosen, "--samples", "2", "--workers", "1", "--json")
    return done | run_facts(checkout, run)


def rebuilt(checkout: Checkout) -> Facts:
    """The demo's scan, rebuilt with a fixed number of images."""
    run = copied(checkout, "demo", "episodes/scan_0001.mcap", "episodes/trial_0001.mcap", "tasks")
    return {"exit": checkout.gst("rebuild", run, *FIT)["exit"]} | run_facts(checkout, run)


def kitchen(checkout: Checkout) -> Facts:
    """The real kitchen: imported, rebuilt, its held-out views scored."""
    run = checkout.work / "kitchen"
    line = ("import", "rgbd", INPUTS / "kitchen", run, "--max-frames", "60")
    facts: Facts = {"import": checkout.gst(*line)["exit"]}
    facts["episode"] = episode_facts(checkout, run / "episodes" / "scan.mcap")
    facts["rebuild"] = checkout.gst("rebuild", run, *FIT)["exit"]
    facts["evaluate"] = checkout.gst("evaluate", run, "--quiet")["exit"]
    return facts | run_facts(checkout, run) | results_facts(checkout, run / "results")


def kinova(checkout: Checkout) -> Facts:
    """Real runs of an arm and of simulators: replayed, and compared as any import is."""
    run = copied(checkout, "kinova")
    facts: Facts = {"replay": checkout.gst("replay", run, "--workers", "1")["exit"]}
    facts["evaluate"] = checkout.gst("evaluate", run, "--quiet")["exit"]
    return facts | run_facts(checkout, run) | results_facts(checkout, run / "results")


def invented(checkout: Checkout) -> Facts:
    """An invented run with data for every part of a report, soft objects among them."""
    run = copied(checkout, "invented")
    facts: Facts = {"evaluate": checkout.gst("evaluate", run, "--quiet")["exit"]}
    return facts | results_facts(checkout, run / "results")


def published(checkout: Checkout) -> Facts:
    """Every published table, evaluated, and its printed figures recomputed."""
    tables = sorted((INPUTS / "published").glob("*.csv"))
    outs = [checkout.work / "published" / path.stem for path in tables]
    lines = [("evaluate", path, "--out", out) for path, out in zip(tables, outs, strict=True)]
    checks = [("evaluate", "--check-published", path) for path in tables]
    codes = checkout.many([*lines, *checks])
    return {
        path.stem: {"exit": read["exit"], "check": check["exit"]} | results_facts(checkout, out)
        for path, out, read, check in zip(
            tables, outs, codes[: len(tables)], codes[len(tables) :], strict=True
        )
    }


def conformance(checkout: Checkout) -> Facts:
    """What ``check`` says of the MCAP project's files, and of bags that other programs wrote."""
    facts = {}
    for name in ("mcap_conformance", "mcap_foreign_rosbag2"):
        facts[name] = by_file(checkout.gst("check", DATA / name, "--json"))
    return facts


def damaged(checkout: Checkout) -> Facts:
    """What ``check`` and ``recover`` say of damaged files, and what recovery saves."""
    folder = copied(checkout, "damaged")
    facts: Facts = {"check": by_file(checkout.gst("check", folder, "--json"))}
    files = sorted(folder.iterdir())
    facts["recover"] = checkout.gst("recover", *files, "--json")
    new = [path for path in sorted(folder.iterdir()) if path not in files]
    return facts | {path.name: episode_facts(checkout, path) for path in new}


def files_of_tasks_and_robots(checkout: Checkout) -> Facts:
    """What the checkers say of the task and robot files in the tree."""
    tasks = sorted((INPUTS / "tasks").glob("*.toml"))
    robots = sorted((INPUTS / "robots").glob("*.toml"))
    lines = [("robot", "check", path, "--json") for path in robots]
    said = checkout.many([("task", "check", *tasks, "--json"), *lines])
    return {
        "tasks": said[0],
        "robots": dict(zip([each.stem for each in robots], said[1:], strict=True)),
    }


GROUPS: dict[str, Callable[[Checkout], Facts]] = {
    "help": help_texts,
    "demo": demo,
    "replays": replays,
    "rebuilt": rebuilt,
    "kitchen": kitchen,
    "kinova": kinova,
    "invented": invented,
    "published": published,
    "conformance": conformance,
    "damaged": damaged,
    "files": files_of_tasks_and_robots,
}


def make_inputs(checkout: Checkout, run: Path) -> None:
    """Make the inputs once, with the version before the change."""
    INPUTS.mkdir(parents=True)
    shutil.copytree(run, INPUTS / "demo", ignore=shutil.ignore_patterns("results", "logs"))
    shutil.copytree(KITCHEN, INPUTS / "kitchen")
    for name in ("published", "tasks", "robots"):
        shutil.copytree(checkout.root / "datasets" / name, INPUTS / name)
    checkout.gst("import", "kinova", KINOVA, INPUTS / "kinova")
    for path in (INPUTS / "kinova/episodes").glob("*.mcap"):
        if path.stem not in KINOVA_TAKEN:
            path.unlink()
    script = checkout.root / "tests/golden/make_evaluation_run.py"
    print(checkout.python(str(script), str(INPUTS / "invented")).stderr)
    damage(INPUTS / "demo/episodes/trial_0001.mcap", INPUTS / "damaged", random.Random(20261127))
    damage(INPUTS / "kinova/episodes/single_0001.mcap", INPUTS / "damaged", random.Random(1))


def damage(path: Path, folder: Path, rng: random.Random) -> None:
    """Write truncated, cut, bit-flipped and empty copies of an episode."""
    folder.mkdir(exist_ok=True)
    data, name = path.read_bytes(), path.stem
    size = len(data)
    middle = slice(size // 2, size // 2 + size // 50)
    copies = {
        "truncated_third": data[: size // 3],
        "truncated_end": data[: size - 200],
        "no_magic": data[8:],
        "hole": data[: middle.start] + bytes(middle.stop - middle.start) + data[middle.stop :],
        "cut_out": data[: middle.start] + data[middle.stop :],
        "empty": b"",
    }
    for number in range(3):
        flipped = bytearray(data)
        for _ in range(5):
            flipped[rng.randrange(size)] ^= 1 << rng.randrange(8)
        copies[f"flipped_{number}"] = bytes(flipped)
    for kind, content in copies.items():
        (folder / f"{name}_{kind}.mcap").write_bytes(content)


def inputs_hash() -> Facts:
    """A digest of every input, so that goldens of other inputs are not compared."""
    return {
        folder.name: digest(
            b"".join(
                str(path.relative_to(folder)).encode() + digest(path.read_bytes()).encode()
                for path in sorted(folder.rglob("*"))
                if path.is_file()
            )
        )
        for folder in sorted(INPUTS.iterdir())
    }


def main() -> None:
    """Make inputs or goldens."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("checkout", type=Path)
    parser.add_argument("out", type=Path, nargs="?")
    parser.add_argument("--inputs", type=Path, metavar="RUN")
    parser.add_argument("--only", default=",".join(GROUPS))
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="goldens_") as work:
        checkout = Checkout(chosen.checkout, Path(work).resolve())
        if chosen.inputs:
            make_inputs(checkout, chosen.inputs)
        if chosen.out is None:
            return
        chosen.out.mkdir(parents=True, exist_ok=True)
        (chosen.out / "inputs.json").write_text(json.dumps(inputs_hash(), indent=1))
        for name in chosen.only.split(","):
            began = time.monotonic()
            facts = GROUPS[name](checkout)
            text = json.dumps(facts, indent=1, sort_keys=True, ensure_ascii=False)
            (chosen.out / f"{name}.json").write_text(text)
            print(f"{time.monotonic() - began:6.1f} s  {name}", flush=True)


if __name__ == "__main__":
    main()

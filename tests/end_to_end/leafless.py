"""A copy of the product without one leaf, and what the core's commands do in it on a stored run."""

import ast
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from loopback import free_endpoint
from own_process import PACKAGES, PLAYED, ROOT, imports_from
from tracked_files import tracked

from bridge.leaves import LEAVES

COMMANDS = """
import json, sys
from pathlib import Path
import robot_gst
from dashboards.app import create_app
from dashboards.library import Library
from starlette.testclient import TestClient
copy, run = Path(sys.argv[1]), sys.argv[2]
codes = {}
for line in (
    ["check", run],
    ["rebuild", run + "_scan", "--iterations", "3"],
    ["replay", run, "--force", "--workers", "1"],
    ["evaluate", run],
):
    codes[line[0]] = robot_gst.run([*line, "--quiet"])
with TestClient(create_app(Library.open([Path(run)])), base_url="http://127.0.0.1") as pages:
    for page in ("/", "/episode/trial_0001"):
        codes[page] = pages.get(page).status_code
here = [m for n, m in sys.modules.items() if n.split(".")[0] in ("robot_gst", *PACKAGES)]
files = [m.__file__ for m in here if getattr(m, "__file__", None)]
codes["elsewhere"] = [f for f in files if not f.startswith(str(copy))]
Path(sys.argv[3]).write_text(json.dumps(codes))
""".replace("PACKAGES", repr(PACKAGES).strip("()"))


def copy_without(leaf: str | None, to: Path) -> None:
    """Copy what is installed, without a leaf's files and its line in the registry."""
    compiled = [str(p.relative_to(ROOT)) for name in PACKAGES for p in (ROOT / name).rglob("*.so")]
    for name in (*tracked(), *compiled):
        if name.startswith((*(f"{each}/" for each in PACKAGES), "datasets/")) or "/" not in name:
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, to / name)
    if leaf is None:
        return
    for module in LEAVES[leaf].modules:
        path = to / module.replace(".", "/")
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.with_suffix(".py").unlink()
    listing = to / "bridge" / "leaves.py"
    lines = listing.read_text().splitlines(keepends=True)
    table = next(
        node.value
        for node in ast.walk(ast.parse("".join(lines)))
        if isinstance(node, ast.AnnAssign) and ast.unparse(node.target) == "LEAVES"
    )
    assert isinstance(table, ast.Dict)
    entries = zip(table.keys, table.values, strict=True)
    key, value = next((k, v) for k, v in entries if ast.literal_eval(k or value) == leaf)
    assert key is not None
    del lines[key.lineno - 1 : value.end_lineno]
    listing.write_text("".join(lines))


def environment(copy: Path) -> dict[str, str]:
    """Have every process that is started import the copy, not the checkout."""
    start = copy / "start"
    start.mkdir()
    (start / "sitecustomize.py").write_text(imports_from(copy))
    return {**os.environ, "PYTHONPATH": str(start), "PYTHONSAFEPATH": "1"}


def run_without(leaf: str | None, stored: Path, scan: Path, folder: Path) -> dict[str, Any]:
    """Run the core's commands in a copy without a leaf; what came of each, by its name."""
    copy, run, told = folder / "copy", folder / "run", folder / "told.json"
    copy_without(leaf, copy)
    shutil.copytree(stored, run, ignore=shutil.ignore_patterns("trial_0002.*"))
    room = Path(shutil.copytree(scan, folder / "run_scan"))
    env = environment(copy)
    command = [sys.executable, "-c", COMMANDS, str(copy), str(run), str(told)]
    done = subprocess.run(
        command, env=env, cwd=folder, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    found: dict[str, Any] = json.loads(told.read_text())
    results = json.loads((run / "results" / "results.json").read_text())
    found["measurements"] = {m["id"]: [m["value"], m["n"]] for m in results["measurements"]}
    found["splats"] = (room / "scene" / "background.ply").read_bytes()
    return found | {"record": record_again(env, run, folder / "recorded")}


def record_again(env: dict[str, str], run: Path, into: Path) -> int:
    """Record a stored trial from the wire; how many messages of the robot and cameras arrived."""
    start = [sys.executable, "-m", "robot_gst"]
    at = free_endpoint()
    record = [*start, "record", str(into), "--listen", at, "--quiet"]
    recorder = subprocess.Popen(record, env=env, cwd=into.parent)
    try:
        for _ in range(60):
            status = [*start, "ctl", "status", "--connect", at, "--quiet"]
            if subprocess.run(status, env=env, capture_output=True, check=False).returncode == 0:
                break
        trial = str(run / "episodes" / "trial_0001.mcap")
        play = [sys.executable, str(PLAYED), trial, at, "again", "20"]
        subprocess.run(play, env=env, capture_output=True, check=True, timeout=120)
    finally:
        recorder.terminate()
        recorder.wait(30)
    shown = [*start, "info", str(into / "episodes" / "again.mcap"), "--json"]
    told = subprocess.run(shown, env=env, capture_output=True, text=True, check=True).stdout
    topics = json.loads(told)["topics"]
    # The recorder adds its losses, and notes among the events: on a busy machine it may be deaf.
    own = [t["topic"].startswith("/recorder/") or t["topic"].endswith("/event") for t in topics]
    return sum(t["count"] for t, its in zip(topics, own, strict=True) if not its)

"""A new scene takes the old one's place at one instant, whatever happens meanwhile."""

import os
import shutil
import sys
from itertools import count
from pathlib import Path
from typing import Any, NoReturn

import pytest
from small_scene import CONFIG, QUIET

from bridge import whole_file
from bridge.episode.run_folder import RunFolder
from twin.scene.rebuild import run as rebuilding
from twin.scene.rebuild.run import rebuild
from twin.scene.settings import RebuildConfig
from twin.scene.store.folder import read_scene, scene_beside

CHANGES = ("open", "os.mkdir", "os.remove", "os.rename", "os.rmdir", "ctypes.set_errno")
FILES = ("scene.json", "background.ply", "objects/cube/mesh.ply")


def content(place: Path) -> dict[str, bytes]:
    files = [path for path in place.rglob("*") if path.is_file()]
    return {str(path.relative_to(place)): path.read_bytes() for path in files}


def write(run: RunFolder, text: bytes) -> None:
    for name in FILES:
        path = run.scene_dir / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text)


def killed_at(run: RunFolder, change: int) -> bool:
    """Replace a scene in a process that ends at so manyth change; whether it ended before."""
    child = os.fork()
    if child == 0:
        left = count(change, -1)

        def end(event: str, _: Any) -> None:
            if event in CHANGES and next(left) == 0:
                os._exit(9)

        sys.addaudithook(end)
        with scene_beside(run) as new:
            write(new, b"new")
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9


def test_a_kill_at_any_instant_leaves_the_old_scene_or_the_new_one(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path)
    seen = set()
    for change in count():
        shutil.rmtree(run.scene_dir, ignore_errors=True)
        write(run, b"old")
        (run.scene_dir / "calibration.json").write_bytes(b"cameras")
        was_killed = killed_at(run, change)
        found = content(run.scene_dir)
        assert found.pop("calibration.json") == b"cameras"
        assert found.keys() == set(FILES)
        (text,) = set(found.values())
        seen.add((text, was_killed))
        if not was_killed:
            break
    assert seen == {(b"old", True), (b"new", True), (b"new", False)}
    assert change > 15
    assert [path.name for path in run.path.glob("scene*")] == ["scene"]


def test_where_folders_cannot_be_exchanged_they_are_renamed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = RunFolder.create(tmp_path)
    write(run, b"old")
    monkeypatch.setattr(whole_file.ctypes, "CDLL", lambda _: object())
    with scene_beside(run) as new:
        write(new, b"new")
    assert content(run.scene_dir) == dict.fromkeys(FILES, b"new")
    assert [path.name for path in run.path.glob("scene*")] == ["scene"]


STEPS = ("write_ply", "_hold_out", "_write_parts", "make_record", "write_record")


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.usefixtures("few_voxels")
def test_a_rebuild_that_fails_while_it_writes_leaves_the_old_scene(
    room: RunFolder, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    before = content(room.path)
    real = getattr(rebuilding, step)

    def full(*given: Any, **named: Any) -> NoReturn:
        real(*given, **named)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(rebuilding, step, full)
    other = RebuildConfig(fit=CONFIG.fit, initialise=CONFIG.initialise, force=True)
    with pytest.raises(OSError, match="No space left"):
        rebuild(room, other, QUIET)
    after = content(room.path)
    assert {name: after[name] for name in before if "views" not in name} == {
        name: data for name, data in before.items() if "views" not in name
    }
    assert {name for name in after if name.startswith("scene.part")} == set()
    assert len(read_scene(room).background) > 0
    for name in (name for name in before if "views" in name):
        assert name in after

"""What the core does without a leaf."""

import sys
from pathlib import Path

import pytest

from bridge.episode.run_folder import RunFolder
from bridge.errors import MissingDependencyError
from twin.leaves import LEAVES, Leaf, has_leaf, load_leaf

GONE = Leaf(entry="twin.scene.gone.things:name", extra="foundation", purpose="naming things")


@pytest.mark.parametrize("name", sorted(LEAVES))
def test_every_leaf_has_its_function(name: str) -> None:
    assert has_leaf(name)
    assert callable(load_leaf(name))


def test_a_leaf_that_is_gone_names_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(LEAVES, "name_things", GONE)
    assert not has_leaf("name_things")
    with pytest.raises(MissingDependencyError, match=r"naming things.*robot-gst\[foundation\]"):
        load_leaf("name_things")


def test_a_scene_is_rebuilt_without_names_of_its_things(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parent / "scene"))
    from small_scene import rebuild_room

    from twin.scene.store.folder import read_record

    monkeypatch.setitem(LEAVES, "name_things", GONE)
    run = rebuild_room(tmp_path)
    record = read_record(RunFolder(run.path))
    assert record is not None
    assert "semantics" not in record
    assert record["fit"]["iterations"] == 6
    assert not (run.scene_dir / "semantics.npz").exists()
    sys.modules.pop("small_scene", None)

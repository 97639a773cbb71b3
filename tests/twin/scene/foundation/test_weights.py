"""A folder of weights is looked at before anything in it is loaded."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from small_files import write_safetensors

from twin.scene.foundation import loading

KIND = loading.WeightsKind(
    name="Owl",
    model_types=("owl",),
    origin="makers/owl",
    licence="Owl License, access on request",
    class_name="OwlModel",
    colours=((0.4, 0.5, 0.6), (0.2, 0.2, 0.3)),
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    place = tmp_path / "owl"
    place.mkdir()
    (place / "config.json").write_text(json.dumps({"model_type": "owl", "size": 3}))
    write_safetensors(place / "model.safetensors", {"a": np.ones((2, 3)), "b": np.zeros(4)})
    (place / "tokenizer.json").write_text("{}")
    return place


def split_in_two(folder: Path) -> None:
    (folder / "model.safetensors").unlink()
    names = {"a": "model-1.safetensors", "b": "model-2.safetensors"}
    for tensor, name in names.items():
        write_safetensors(folder / name, {tensor: np.ones(5)})
    (folder / "model.safetensors.index.json").write_text(json.dumps({"weight_map": names}))


def test_a_whole_folder_is_accepted_in_one_file_or_in_parts(folder: Path) -> None:
    loading.check_folder(folder, KIND)
    split_in_two(folder)
    loading.check_folder(folder, KIND)
    assert [path.name for path in loading.weight_files(folder, KIND)] == [
        "model-1.safetensors",
        "model-2.safetensors",
    ]


def test_the_refusal_names_the_files_that_are_needed_and_the_licence(tmp_path: Path) -> None:
    with pytest.raises(loading.WeightsError, match="no such folder") as caught:
        loading.check_folder(tmp_path / "nothing", KIND)
    for word in ("config.json", "model.safetensors", "tokenizer.json", "makers/owl", "on request"):
        assert word in str(caught.value)
    assert caught.value.exit_code == 2


def cut_short(folder: Path) -> None:
    path = folder / "model.safetensors"
    path.write_bytes(path.read_bytes()[:-4])


def pickled(folder: Path) -> None:
    (folder / "model.safetensors").unlink()
    (folder / "pytorch_model.bin").write_bytes(b"\x80\x04")


def a_part_missing(folder: Path) -> None:
    split_in_two(folder)
    (folder / "model-2.safetensors").unlink()


def a_part_elsewhere(folder: Path) -> None:
    split_in_two(folder)
    text = json.dumps({"weight_map": {"a": "../model-1.safetensors"}})
    (folder / "model.safetensors.index.json").write_text(text)


def set_text(name: str, text: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_text(text) and None


def removed(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (removed("config.json"), "no config.json"),
        (set_text("config.json", "["), "not JSON"),
        (set_text("config.json", "[]"), "not an object"),
        (set_text("config.json", '{"model_type": "cat"}'), "type 'cat', not 'owl'"),
        (removed("model.safetensors"), "1 of 1 safetensors files are missing"),
        (removed("tokenizer.json"), "no tokenizer.json"),
        (pickled, "pytorch_model.bin, which can run code when opened"),
        (cut_short, "cut short"),
        (set_text("model.safetensors", "version 1 of a pointer"), "git-lfs pointer"),
        (set_text("model.safetensors", "abc"), "cut short"),
        (set_text("model.safetensors", "\x02\0\0\0\0\0\0\0[]"), "no safetensors file"),
        (a_part_missing, "1 of 2 safetensors files are missing, first 'model-2"),
        (a_part_elsewhere, "1 of 1 safetensors files are missing, first '../model-1"),
    ],
)
def test_a_damaged_folder_is_refused_with_one_sentence_that_says_how(
    folder: Path, damage: Callable[[Path], None], said: str
) -> None:
    damage(folder)
    with pytest.raises(loading.WeightsError) as caught:
        loading.check_folder(folder, KIND)
    assert said in str(caught.value)
    assert "docs/foundation_models.md" in str(caught.value)


def test_the_hash_changes_with_the_numbers_alone(folder: Path) -> None:
    before = loading.check_folder(folder, KIND)
    write_safetensors(folder / "model.safetensors", {"a": np.full((2, 3), 2.0), "b": np.zeros(4)})
    assert loading.check_folder(folder, KIND) != before


def test_colours_are_normalised_as_the_folder_says(folder: Path) -> None:
    assert loading.read_normalisation(folder, KIND) == KIND.colours
    about = folder / "preprocessor_config.json"
    about.write_text(json.dumps({"image_mean": [0.1, 0.2, 0.3], "size": 4}))
    assert loading.read_normalisation(folder, KIND) == ((0.1, 0.2, 0.3), KIND.colours[1])
    for broken in ([0.1], "x", [0.1, None, 0.2], [1, 2, 300]):
        about.write_text(json.dumps({"image_std": broken}))
        with pytest.raises(loading.WeightsError, match="image_std is"):
            loading.read_normalisation(folder, KIND)
    about.write_text(json.dumps({"image_std": [0.5, 0.0, 0.5]}))
    with pytest.raises(loading.WeightsError, match="image_std is"):
        loading.read_normalisation(folder, KIND)

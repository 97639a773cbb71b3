"""The field's words: one row for each word that this project used in a sense of its own.

A row lists where the old word must not come back: in names of files and modules, in identifiers,
in text (docstrings, help, messages, documents, pages). Readers of old files are exempt by name.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest
from own_process import ROOT
from source_facts import source_facts
from tracked_files import tracked

PACKAGES = ("bridge", "twin", "evaluator", "dashboards")


@dataclass(frozen=True, kw_only=True)
class Word:
    """One word and the patterns that find it in the sense that was left behind."""

    use: str
    """What a reader of the field expects instead."""
    files: str = ""
    """Whole names of files or folders, without their ending."""
    names: str = ""
    """Found anywhere in an identifier that is defined here, split at underscores and capitals."""
    whole: str = ""
    """A whole identifier that is defined here."""
    text: str = ""
    """Found in a string, a docstring or a document, whatever its case."""
    under: tuple[str, ...] = ()
    """Where the row holds; everywhere without it."""
    besides: tuple[str, ...] = ()
    """Files that read what old versions wrote, and may say so."""


WORDS = {
    "relive": Word(
        use="replay, executed", files="relive", names="relive|lived", text=r"re-?liv(e|ed|es|ing)\b"
    ),
    "parting": Word(
        use="divergence, diverge",
        files="parting",
        names="parting",
        text=r"\bpartings?\b|\bpart(s|ed)? from (the|each|its|what|reality|real)\b",
    ),
    "telling": Word(use="trajectory", files="tellings?", names="tellings?", text=r"\btellings?\b"),
    "place": Word(use="scene", files="place", whole="Place", text=r"rebuilt place"),
    "chance": Word(use="monte_carlo", files="chance", names="chances?", under=("twin",)),
    "furnish": Word(use="spawn", files="furnish", names="furnish(ed)?", text=r"\bfurnish"),
    "clearance": Word(
        use="bounding spheres, static obstacles, unmodelled obstacles",
        files="shells|standing|unnamed|near",
        names="shells?|standing|unnamed",
        under=("twin/replay",),
    ),
    "hold": Word(use="grasp, slip", files="hold|hair", names="hair|Hold", under=("twin",)),
    "crew": Word(use="process pool, serial", files="crew", names="crew|Alone", text=r"\bcrews?\b"),
    "eyes": Word(use="perception", files="eyes", names="[Ee]yes"),
    "learn": Word(
        use="dataset, TrainingSet", files="learn", names="Learnt|learnt", under=("twin",)
    ),
    "carried pixels": Word(
        use="ego mask", files="carried", names="carried", under=("twin/scene/dataset",)
    ),
    "witness": Word(
        use="reference view; perceived outcome",
        files="witness",
        names="witness(es)?",
        text=r"\bwitness",
    ),
    "thumb": Word(
        use="downscaled, from TF, stationary",
        files="thumb|stated|still",
        names="thumbs?|stated|still",
        under=("twin",),
    ),
    "take apart": Word(
        use="decompose, residual, assignment",
        files="remains|owners|apart",
        names="apart|remains|owners",
        text=r"\btak(e|es|en|ing) apart\b",
        under=("twin", "evaluator", "docs"),
    ),
    "form": Word(
        use="shape descriptors, part segmentation",
        files="form|limbs|solid",
        names="limbs?",
        under=("twin/scene/semantics",),
    ),
    "belief": Word(
        use="posterior, nominal",
        files="beliefs?",
        names="beliefs?|believed",
        text=r"\bbelie(f|ved)",
        under=("twin", "evaluator"),
    ),
    "take": Word(
        use="episode recording, input queue, publisher liveliness, disk reserve",
        files="take|intake|departures|reserve",
        names="Take|intake|departures?",
        under=("bridge/record",),
    ),
    "said": Word(
        use="verdict summary",
        files="said",
        names="said|Said",
        under=("twin", "evaluator", "dashboards"),
    ),
    "evaluator's modules": Word(
        use="prediction-powered estimate, plot data, scorecard, settings check, notes",
        files="fewer|drawn|worth|made_alike|remarks",
        names="remarks?|worth",
        under=("evaluator",),
    ),
    "ledger": Word(
        use="dropped (logged), drop log", text=r"\bdeclared (lost|loss|losses)\b|\bledger"
    ),
    "cell": Word(
        use="group (task x policy x condition); a cell is the robot cell",
        text=r"\bover (the )?\w* ?cells\b|\bcells?; it needs\b|\bcells of (the|a) (table|study)\b",
        under=("evaluator", "dashboards", "docs", "README.md"),
    ),
    "is no": Word(
        use="is not a ...", text=r"\bis no (run|success rate|rate|number|episode|folder)\b"
    ),
    "sentence": Word(
        use="a clear error message", text=r"\b(in|with|by) (a|one) sentence\b|\bone sentence\b"
    ),
    "drawn weights": Word(use="randomly initialised weights", text=r"\bdrawn (weights|network)"),
    "surely right": Word(use="confident", text=r"\bsurely (right|wrong)\b"),
    "evidence": Word(use="e-value (anytime-valid)", text=r"evidence, not an estimate"),
    "worst case": Word(
        use="guaranteed coverage at this n",
        text=r"\bworst case\b",
        under=("evaluator", "README.md"),
    ),
    "nowhere asked": Word(
        use="no executed trial has an advisory verdict", text=r"nowhere asked|without being obeyed"
    ),
    "speak on the wire": Word(
        use="publish sensor and robot data over zenoh; verify an episode and list dropped messages",
        text=r"\bspeaks? on the wire\b|whether an episode is whole",
    ),
    "room": Word(
        use="package, module", files="rooms?", names="rooms", text=r"\brooms\b|\b(of|in) the room\b"
    ),
}


def files_of(word: Word) -> list[str]:
    roots = (*PACKAGES, "docs", "README.md", "CONTRIBUTING.md", "robot_gst.py", "examples")
    found = []
    for name in tracked():
        inside = any(name == root or name.startswith(f"{root}/") for root in word.under or roots)
        if inside and name not in word.besides and not name.startswith("docs/decisions/"):
            found.append(name)
    return found


def parts_of(identifier: str) -> list[str]:
    """Split at underscores and capitals, and keep the whole as well."""
    return [*re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z0-9]+", identifier), identifier]


@cache
def is_left_behind(identifier: str, word: Word) -> bool:
    """Whether an identifier is the old word or has it as a part."""
    if word.whole and re.fullmatch(word.whole, identifier):
        return True
    return bool(word.names) and any(re.fullmatch(word.names, part) for part in parts_of(identifier))


@cache
def texts_of(name: str) -> tuple[tuple[int, str], ...]:
    """Strings of a Python file, or all of a document, with their lines."""
    path = ROOT / name
    return source_facts(path).texts if name.endswith(".py") else ((1, path.read_text()),)


@cache
def all_text_of(name: str) -> str:
    return "\n".join(text for _, text in texts_of(name))


def offences(word: Word) -> Iterator[str]:
    for name in files_of(word):
        for part in Path(name).with_suffix("").parts:
            if word.files and re.fullmatch(word.files, part):
                yield f"{name}: the file's name"
        if name.endswith(".py"):
            for line, identifier in source_facts(ROOT / name).defined:
                if is_left_behind(identifier, word):
                    yield f"{name}:{line}: {identifier}"
        elif not name.endswith((".md", ".html", ".js", ".toml")):
            continue
        if not word.text or not re.search(word.text, all_text_of(name), re.IGNORECASE):
            continue
        for line, text in texts_of(name):
            for found in re.finditer(word.text, text, re.IGNORECASE):
                where = line + text[: found.start()].count("\n")
                yield f"{name}:{where}: {found.group(0)}"


@pytest.mark.parametrize("row", WORDS)
def test_the_old_word_stays_away(row: str) -> None:
    found = list(offences(WORDS[row]))
    assert not found, f"use {WORDS[row].use}:\n" + "\n".join(found[:40])


@pytest.mark.parametrize("name", ["Place", "Finding", "FitConfig", "Surface", "Stage"])
def test_a_class_name_has_one_meaning(name: str) -> None:
    defined = [
        path
        for path in tracked()
        if path.startswith(PACKAGES) and path.endswith(".py")
        if re.search(rf"^class {name}\b", (ROOT / path).read_text(), re.MULTILINE)
    ]
    assert len(defined) <= 1, defined


def test_a_judge_stands_in_one_file() -> None:
    assert len([path for path in tracked() if Path(path).name == "judge.py"]) <= 1

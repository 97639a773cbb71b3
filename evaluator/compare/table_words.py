"""Words that people write above the columns of their results, and what a cell holds."""

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass

from bridge.errors import UsageError
from bridge.exchange.table_text import ENDED, MEASURED, UNKNOWN, answer_of

LABELS = {
    "task": "task tasks task_name scenario scenarios aufgabe tache experiment benchmark env",
    "policy": "policy policies model models method methods algorithm checkpoint agent approach "
    "policy_name modell modele methode strategie verfahren",
    "condition": "condition study_arm bedingung",
    "trial": "trial trial_id trial_number episode episode_id rollout attempt id nr versuch essai",
    "start_id": "start_id start initial_condition init_state",
    "unit": "unit",
    **{ours: " ".join(names) for ours, names in MEASURED.items()},
    "side": "side domain environment sim_or_real real_or_sim where seite",
}
"""Our name of a column that says what a row is about, and other people's."""
SIDE_WORDS = {
    "real": "real real_world realworld real_robot robot hardware recorded physical reell reel",
    "sim": "sim simulation simulated simulator twin digital_twin simuliert simule wm world_model",
    "stand-in": "stand_in standin",
}
FIGURE_WORDS = {
    "k": "k successes num_successes num_success n_success wins erfolge",
    "n": "n trials num_trials n_trials episodes num_episodes rollouts num_rollouts attempts "
    "versuche essais total",
    "rate": "rate success_rate sr success_rates erfolgsrate taux_de_succes taux",
    "percent": "rate_percent success_rate_percent sr_percent percent pct prozent",
    "outcome": "outcome result results success succeeded erfolg succes resultat ergebnis recorded",
}
_CHINESE = "仿真=sim,真实世界=real,真机=real,真实=real,成功率=success rate,方法=method,任务=task"
TRANSLATED = dict(pair.split("=") for pair in _CHINESE.split(","))
"""Words of a script without blanks between them, each as one of the above."""
AXES = ("x", "y")
"""Said of which axis of a figure a column is, and nothing more."""
SUMMARIES = "average avg mean overall total mittel mittelwert durchschnitt gesamt moyenne"
"""Rows and columns that begin so sum up the others."""
BESIDE = (
    "std sd se sem ci low high lower upper min max err error dev var p time duration steps length "
    "progress score reward gap diff difference delta s"
)
"""Words for what stands beside a rate and is none."""


class DoubtfulTableError(UsageError):
    """A table has a likely reading, and another one that is possible."""


def folded(name: str) -> str:
    """Return a name without case, accents and signs."""
    text = unicodedata.normalize("NFKD", name.casefold().replace("%", " percent "))
    text = "".join(letter for letter in text if not unicodedata.combining(letter))
    return re.sub(r"[\W_]+", "_", text).strip("_")


def _by_word(table: dict[str, str]) -> dict[str, str]:
    return {word: ours for ours, words in table.items() for word in words.split()}


_LABEL, _SIDE, _FIGURE = _by_word(LABELS), _by_word(SIDE_WORDS), _by_word(FIGURE_WORDS)
KNOWN = (*_LABEL, *_SIDE, *_FIGURE)
"""Every word that stands alone above a column."""
_N_INSIDE = re.compile(r"\(?\b[nN]\s*=\s*(\d+)\)?")


@dataclass(frozen=True)
class Column:
    """What a column holds, by its name alone."""

    place: int
    name: str
    label: str = ""
    """task, policy, condition, trial, start_id, unit or side."""
    side: str = ""
    figure: str = ""
    """k, n, rate, percent or outcome."""
    n: int | None = None
    rest: str = ""
    """What the name says beyond side and figure: a task or a policy."""

    @property
    def is_beside(self) -> bool:
        """Whether the name says something about a rate, and not a rate."""
        return bool(self.rest) and set(folded(self.rest).split("_")) <= set(BESIDE.split())


def side_of(text: str) -> str:
    """Return the side that a whole text names; empty for any other."""
    return _SIDE.get(folded(text), "")


def side_within(text: str) -> tuple[str, str]:
    """Return the side that one end of a name says, and the rest of the name; empty without."""
    parts = [part for part in re.split(r"[\W_]+", text) if part]
    for word, rest in ((parts[-1:], parts[:-1]), (parts[:1], parts[1:])):
        if rest and word and _SIDE.get(folded(word[0])) and folded(word[0]) != "robot":
            cut = text.strip(" _-()[]:,/")
            kept = re.sub(rf"(^{word[0]}\b|^{word[0]}_|[\W_]{word[0]}$)", "", cut)
            return _SIDE[folded(word[0])], kept.strip(" _-()[]:,/")
    return "", text


def is_summary(text: str) -> bool:
    """Whether a row or a column of this name sums up others."""
    return folded(text).split("_")[0] in SUMMARIES.split()


def read_name(place: int, levels: Sequence[str]) -> Column:
    """Say what a column holds; ``levels`` are its names from the top row of the header down."""
    parts = list(dict.fromkeys(part for part in levels if part))
    name = " ".join(parts)
    whole = folded(_translated(parts[-1])) if parts else ""
    if whole in _LABEL and all(folded(_translated(part)) in _LABEL for part in parts):
        return Column(place=place, name=name, label=_LABEL[whole])
    side = figure = ""
    n: int | None = None
    rest: list[str] = []
    sides = {_SIDE.get(folded(word)) for word in re.split(r"[\W_]+", _translated(name))}
    if len(sides - {None}) > 1:
        return Column(place=place, name=name, rest="difference")
    for part in map(_translated, parts):
        inside = _N_INSIDE.search(part)
        if inside:
            n, part = int(inside[1]), _N_INSIDE.sub(" ", part)  # noqa: PLW2901
        words = [word for word in re.split(r"[\s()\[\]:,/]+|(?=%)", part) if word]
        found = [_known(words)] if folded(part) in (*_SIDE, *_FIGURE) else []
        for a_side, a_figure, left in found or [_sorted_out(words, " ")]:
            side = side or a_side
            figure = a_figure if a_figure == "percent" or not figure else figure
            rest += [left] if left and folded(left) not in AXES else []
    return Column(place=place, name=name, side=side, figure=figure, rest=" ".join(rest), n=n)


def _translated(name: str) -> str:
    for word, ours in TRANSLATED.items():
        name = name.replace(word, f" {ours} ")
    return name.strip()


def _known(words: Sequence[str]) -> tuple[str, str, str]:
    whole = folded(" ".join(words))
    return _SIDE.get(whole, ""), _FIGURE.get(whole, ""), ""


def _sorted_out(words: Sequence[str], joint: str) -> tuple[str, str, str]:
    """Return side, figure and what else some words say, the longest known expressions first."""
    side = figure = ""
    left: list[str] = []
    place = 0
    while place < len(words):
        size = next((n for n in (3, 2, 1) if any(_known(words[place : place + n])[:2])), 0)
        if size:
            a_side, a_figure, _ = _known(words[place : place + size])
            side, figure = side or a_side, figure or a_figure
            figure = "percent" if a_figure == "percent" else figure
        elif joint == " " and (sign := next((s for s in "_-" if s in words[place]), "")):
            a_side, a_figure, kept = _sorted_out(words[place].split(sign), sign)
            side, figure = side or a_side, figure or a_figure
            left += [kept] if kept else []
        else:
            left.append(words[place])
        place += size or 1
    return side, figure, joint.join(filter(folded, left))


@dataclass(frozen=True, kw_only=True)
class Figure:
    """What one cell holds."""

    row: int
    text: str
    k: int | None = None
    n: int | None = None
    number: str = ""
    """As printed, with a point."""
    percent: bool = False
    answer: bool | None = None
    ended: bool = False
    """Whether it says how a trial ended that has no outcome."""

    @property
    def is_certain(self) -> bool:
        """Whether it is a rate by its own looks."""
        return self.n is not None or self.percent

    @property
    def value(self) -> float:
        """The number as it stands."""
        return float(self.number)


_NUMBER = r"[+-]?\d+(?:[.,]\d+)?|[+-]?\.\d+"
_SPREAD = re.compile(rf"\s*(?:±|\+/?-|\\pm)\s*(?:{_NUMBER})\s*%?$")
_SHARE = re.compile(rf"({_NUMBER})\s*(%?)")
_COUNT = re.compile(r"(\d+)\s*(?:/|of|out of|von|sur)\s*(\d+)", re.IGNORECASE)
_BOTH = re.compile(rf"({_NUMBER})\s*%\s*\(({_COUNT.pattern})\)", re.IGNORECASE)
_TURNED = re.compile(rf"({_COUNT.pattern})\s*\(({_NUMBER})\s*%\)", re.IGNORECASE)
_DATE = re.compile(
    r"\d{1,2}[-. ]\s?[A-Za-zäé]{3,9}\.?|[A-Za-zäé]{3,9}[-. ]\d{1,4}|\d{4}-\d\d-\d\d.*"
    r"|\d{1,2}[./]\d{1,2}[./]\d{2,4}|\d{1,2}:\d\d(:\d\d)?"
)


class CellError(ValueError):
    """A cell that is no figure; its text says why."""


def read_cell(row: int, text: str) -> Figure | None:
    """Read one cell; None where nobody knows.

    Raises:
        CellError: For a text that is neither a share, nor a count, nor an answer.
    """
    cut = _SPREAD.sub("", unicodedata.normalize("NFKC", text).strip())
    cut = _TURNED.sub(r"\4% (\1)", cut)
    if cut.lower() in UNKNOWN:
        return None
    if both := _BOTH.fullmatch(cut):
        number = _pointed(both[1])
        return Figure(row=row, text=text, k=int(both[3]), n=int(both[4]), number=number)
    if count := _COUNT.fullmatch(cut):
        k, n = int(count[1]), int(count[2])
        if not 0 <= k <= n or not n:
            raise CellError(f"{k} of {n} is not a possible count")
        return Figure(row=row, text=text, k=k, n=n)
    if cut.lower() in ENDED:
        return Figure(row=row, text=cut, ended=True)
    answer = answer_of(cut)
    if share := _SHARE.fullmatch(cut):
        number = _pointed(share[1], percent=bool(share[2]))
        return Figure(row=row, text=text, number=number, percent=bool(share[2]), answer=answer)
    if answer is not None:
        return Figure(row=row, text=text, answer=answer)
    if _DATE.fullmatch(cut):
        raise CellError("is a date or a time; a spreadsheet makes one of 7/10: write '7 of 10'")
    raise CellError("is neither a rate, nor a count, nor an answer")


def is_number(text: str) -> bool:
    """Whether a cell is a plain number."""
    return re.fullmatch(_NUMBER, text.strip()) is not None


def is_share(text: str) -> bool:
    """Whether a cell is a part of 1, or percent with their sign; 3 of some scale is neither."""
    found = _SHARE.fullmatch(text.strip())
    return found is not None and (bool(found[2]) or float(found[1].replace(",", ".")) <= 1)


def _pointed(text: str, *, percent: bool = False) -> str:
    if not percent and re.fullmatch(r"[+-]?[1-9]\d*,\d{3}", text):
        raise CellError("may be a decimal comma or one between thousands: write a point")
    return text.replace(",", ".")

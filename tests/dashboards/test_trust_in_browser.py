"""The first page in a real browser: filters, orders, narrow and wide, light and dark."""

import threading
from collections.abc import Iterator

import pytest
import uvicorn
from headless import CHROMIUM, NO_CHROMIUM, Browser, chromium
from test_review_index import HOSTILE, many

from bridge.episode.run_folder import RunFolder
from dashboards.app import create_app
from dashboards.config import DashboardConfig
from dashboards.library import Library
from dashboards.server import listen
from evaluator.quantity import slug
from evaluator.review_index import FACETS, index_path, state_of, written_index

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Browser, str]]:
    """A browser, and the address of a run of 120 trials, a third with a hostile task."""
    run = RunFolder.create(tmp_path_factory.mktemp("runs") / "many")
    about = {
        "state": state_of(run).digest, "changed_meanwhile": False, "results_reason": None,
        "outdated": None, "comparison_reason": None, "measurements": [],
        "tasks": [{"task": t, "slug": slug(t), "answer": "not yet", "sentence": f"{t}: few."}
                  for t in ("pour", HOSTILE)],
        "failures": [["sim planned", "clearance", "collision", 96], ["real", HOSTILE, "", 3]],
        "missing": [HOSTILE],
    }  # fmt: skip
    trials = many()
    slugs = [{name: slug(getattr(trial, name)) for name in FACETS} for trial in trials]
    path = index_path(run)
    path.parent.mkdir(parents=True)
    path.write_bytes(written_index(zip(trials, slugs, strict=True), (), about))
    listener = listen(DashboardConfig(port=0))
    server = uvicorn.Server(
        uvicorn.Config(create_app(Library.open([run.path])), log_level="warning", lifespan="off")
    )
    server.install_signal_handlers = lambda: None  # type: ignore[method-assign]
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        with chromium(tmp_path_factory.mktemp("home")) as tab:
            yield tab, f"http://127.0.0.1:{listener.getsockname()[1]}/"
    finally:
        server.should_exit = True
        thread.join(20)
        listener.close()


@pytest.mark.parametrize("width", [390, 1440, 2560])
@pytest.mark.parametrize("dark", [False, True])
def test_no_name_widens_the_page_and_nothing_is_complained_of(
    page: tuple[Browser, str], width: int, dark: bool
) -> None:
    tab, url = page
    tab.show(url, width=width, dark=dark)
    assert tab.ask("document.documentElement.scrollWidth") <= width
    assert tab.complaints == []
    assert all(address.startswith(url) for address in tab.asked)
    assert tab.ask("document.querySelectorAll('.trials tbody tr').length") == 50


def test_from_a_cause_to_its_trials_and_back(page: tuple[Browser, str]) -> None:
    tab, url = page
    tab.show(url, width=1440, dark=False)
    link = tab.ask("document.querySelector('.by-twin a').href")
    tab.show(link, width=1440, dark=False)
    texts = "[...document.querySelectorAll('.trials tbody tr')].map(row => row.innerText)"
    rows = tab.ask(texts)
    expected = [t for t in many() if t.sim_planned is False and t.failing_cause == "collision"]
    assert len(rows) == len(expected)
    assert all(trial.episode in row for trial, row in zip(expected, rows, strict=True))
    tab.show(tab.ask("document.querySelector('.filters a').href"), width=1440, dark=False)
    assert len(tab.ask(texts)) == 50


def test_a_choice_and_a_text_select_together_and_stand_in_the_address(
    page: tuple[Browser, str],
) -> None:
    tab, url = page
    tab.show(f"{url}?sort=-name", width=1440, dark=False)
    tab.ask("document.querySelector('[name=q]').value = 'S3'")
    before = tab.num_loaded
    tab.ask(
        "(() => { const choice = document.querySelector('[name=task]'); choice.value = 'pour';"
        "choice.dispatchEvent(new Event('change')); })()"
    )
    tab.await_load(before)
    address = tab.ask("location.search")
    assert "q=S3" in address
    assert "task=pour" in address
    assert "sort=-name" in address
    names = tab.ask("[...document.querySelectorAll('.trials th a')].map(a => a.innerText)")
    expected = [t.episode for t in many() if t.task == "pour" and "s3" in str(t.start_id)]
    assert [name for name in names if name.startswith("trial_")] == expected[::-1]


def test_what_is_told_by_colour_is_told_in_words_too(page: tuple[Browser, str]) -> None:
    tab, url = page
    tab.show(url, width=390, dark=True)
    marks = tab.ask("[...document.querySelectorAll('.mark')].map(mark => mark.innerText)")
    assert marks
    assert all(any(letter.isalpha() for letter in mark) for mark in marks)
    shown = "getComputedStyle(document.querySelector('.trials thead')).display"
    assert tab.ask(shown) == "none"
    labels = "getComputedStyle(document.querySelector('td[data-label]'), '::before').content"
    assert "recorded" in tab.ask(labels)

"""Every page of a run: nothing keeps anybody from reading it, narrow or wide, light or dark."""

from collections.abc import Iterator

import pytest
from headless import ACCESSIBLE, CHROMIUM, NO_CHROMIUM, Browser, chromium
from serving import dashboard

from bridge.episode.run_folder import RunFolder

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)]

PAGES = (
    *("", "?show=disagree&sort=-name", "?q=nothing+is+called+that", "?task=elsewhere"),
    *("?condition=with_replanning", "numbers", "twin"),
    *("label", "label?rater=Ann", "label?show=1"),
    *("failures", "failures?failed=wrong_no", "live"),
    *("episode/trial_0001", "episode/trial_0002?t=1", "episode/trial_0004", "nowhere"),
)


@pytest.fixture(scope="module")
def page(
    shared_run: RunFolder, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Browser, str]]:
    """A browser, and the address of a run of four trials."""
    with dashboard(shared_run) as (_, url), chromium(tmp_path_factory.mktemp("home")) as tab:
        yield tab, url


@pytest.mark.parametrize(
    ("width", "dark"), [(390, False), (1440, True)]
)  # neither hangs on the other
@pytest.mark.parametrize("address", PAGES)
def test_every_page_can_be_read_by_everyone(
    page: tuple[Browser, str], address: str, width: int, dark: bool
) -> None:
    tab, url = page
    tab.show(url + address, width=width, dark=dark)
    tab.ask("document.querySelectorAll('details').forEach((part) => { part.open = true })")
    assert tab.ask(ACCESSIBLE.read_text()) == []
    assert tab.ask("document.documentElement.scrollWidth") <= width
    assert all(asked.startswith((url, "data:", "blob:")) for asked in tab.asked)

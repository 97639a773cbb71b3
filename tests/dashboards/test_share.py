"""One file with chosen trials: whole, small, closed to the outside, readable without a script."""

import base64
import io
import re
from html.parser import HTMLParser
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from test_review_index import HOSTILE
from visible import words

from bridge.episode.run_folder import RunFolder
from bridge.errors import OptionError, UsageError
from bridge.media.color import decode_color
from dashboards import share_file
from dashboards.config import ShareConfig
from dashboards.share_file import LEVELS, MB, build_share, share
from evaluator.report.page import name_shared
from evaluator.report.review import refresh


@pytest.fixture
def run(copy: RunFolder) -> RunFolder:
    """Return a copy of the run, with a report whose place for shared files is empty."""
    (copy.results_dir / "report.html").write_text("<p>x</p><!--shared--><!--/shared--><p>y</p>")
    return copy


class _Addresses(HTMLParser):
    """Everything of a page that could lead outside."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.tags: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for name, value in attrs:
            assert not name.startswith("on"), (tag, name)
            if name in ("src", "href", "poster", "srcset", "action", "data", "background"):
                self.found.append(value or "")


def test_the_file_holds_clips_plots_and_tables_and_the_report_names_it(run: RunFolder) -> None:
    path, made = share(run, ShareConfig(trials=("trial_0001", "trial_0003")))
    assert path == run.results_dir / "shared" / "trials.html"
    text = path.read_text()
    assert (made.trials, made.notes) == (("trial_0001", "trial_0003"), ())
    assert made.size_bytes == path.stat().st_size
    report = (run.results_dir / "report.html").read_text()
    assert '<a href="shared/trials.html">trials.html</a>' in report
    page = _Addresses(text)
    assert "script" not in page.tags
    outward = [a for a in page.found if not a.startswith(("#", "data:"))]
    assert outward == ["../report.html"]
    assert "default-src 'none'" in text
    assert not re.search(r"url\((?!#)|@import|https?://(?!www\.w3\.org/)", text)
    videos = re.findall(r'src="data:video/mp4;base64,([^"]+)"', text)
    assert len(videos) == 2
    av = pytest.importorskip("av")
    with av.open(io.BytesIO(base64.b64decode(videos[0]))) as video:
        assert video.streams.video[0].codec_context.name == "h264"
        assert sum(1 for _ in video.decode(video=0)) > 10
    assert text.count("Tool: recorded to replayed distance") >= 2
    seen = words(text)
    assert "the cube left the gripper during carry" in seen
    assert "Stand-in" in seen
    assert str(run.path.parent) not in text


def test_without_names_the_worst_are_taken_and_a_wrong_name_says_the_nearest(
    run: RunFolder,
) -> None:
    assert build_share(run, ShareConfig()).trials == ("trial_0002",)
    with pytest.raises(UsageError, match="did you mean trial_0001"):
        build_share(run, ShareConfig(trials=("trial_001",)))
    with pytest.raises(OptionError, match="max-mb"):
        ShareConfig(max_mb=21)
    report = build_share(run, ShareConfig(trials=("trial_0004",)), report="")
    assert "report.html" not in report.text


def test_a_smaller_limit_takes_quality_and_then_refuses(run: RunFolder) -> None:
    pytest.importorskip("av")
    names = ("trial_0001", "trial_0002")
    full = build_share(run, ShareConfig(trials=names))
    assert full.clips == next(iter(LEVELS))
    less = build_share(run, ShareConfig(trials=names, max_mb=0.9 * full.size_bytes / MB))
    assert less.clips in [*LEVELS][1:]
    assert less.size_bytes <= 0.9 * full.size_bytes
    assert less.trials == names
    many = tuple(f"trial_000{number}" for number in (1, 2, 3, 4))
    with pytest.raises(
        UsageError, match=r"4 trials take .* MB even with pictures .* limit is 0.01 MB"
    ):
        build_share(run, ShareConfig(trials=many, max_mb=0.01))


def test_without_pyav_a_picture_stands_for_the_clip(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(share_file, "can_film", lambda: False)
    made = build_share(run, ShareConfig(trials=("trial_0002",)))
    assert "<video" not in made.text
    (picture,) = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', made.text)
    assert decode_color(base64.b64decode(picture)).shape[0] == LEVELS[made.clips].height_px
    assert "trial_0002 recorded around the moment when the cube left the gripper" in made.text


def test_hostile_names_stay_text(synthetic: ModuleType, tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run")
    with synthetic.EpisodeWriter(run.episodes_dir / "x.mcap") as writer:
        writer.describe(
            synthetic.EpisodeInfo(id="x", kind="trial", task=HOSTILE, policy=HOSTILE),
            outcome=synthetic.Outcome(
                result="failure", stages=({"id": HOSTILE, "result": "failure"},)
            ),
        )
    refresh(run)
    made = build_share(run, ShareConfig(trials=("x",)))
    assert "<script" not in made.text
    assert "No clip: no camera images in x.mcap" in made.text
    report = tmp_path / "report.html"
    report.write_text("<!--shared--><!--/shared-->")
    (tmp_path / "shared").mkdir()
    (tmp_path / "shared" / "a<b>&\"'.html").write_text("")
    name_shared(report)
    assert "<b>" not in report.read_text()
    assert "a&lt;b&gt;" in report.read_text()


def test_the_page_of_failures_offers_the_file(browser: Any) -> None:
    (address,) = re.findall(r'href="(/share[^"]*)"', browser.get("/failures").text)
    assert address == "/share?trial=trial_0002&amp;trial=trial_0001"
    answer = browser.get(address.replace("&amp;", "&"))
    assert answer.headers["content-disposition"].startswith("attachment")
    assert answer.text.count("<video") == 2
    assert browser.get("/share?trial=..%2Fx").status_code == 404

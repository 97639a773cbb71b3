"""What long work tells about itself without a terminal: how much is done, how long it will take."""

import time

import pytest

from bridge.heartbeat import BEAT, Heartbeat
from bridge.terminal import Output


@pytest.mark.parametrize(
    ("seconds", "done", "total", "told"),
    [
        (20.0, 2, 6, "replay: 2 of 6, about 40 s left, trial_1\n"),
        (60.0, 10, 100, "replay: 10 of 100, about 9 min left, trial_1\n"),
        (60.0, 1, 241, "replay: 1 of 241, about 4.0 h left, trial_1\n"),
        (30.0, 0, 5, "replay: 0 of 5 trial_1\n"),
    ],
)
def test_a_line_says_how_much_is_left_judging_by_what_it_took(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    seconds: float,
    done: int,
    total: int,
    told: str,
) -> None:
    clock = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(BEAT, "said_s", clock[0])
    with Output().progress("replay", total) as advance:
        clock[0] += seconds
        advance(done, "trial_1")
        clock[0] += 1.0
        advance(done + 1, "too soon for another line")
    Output().say("--policy a:x: no")  # no picture of what stands between colons
    assert capsys.readouterr().err == f"{told}--policy a:x: no\n"


def test_a_command_that_says_nothing_is_at_work_or_waits_for_others(
    capsys: pytest.CaptureFixture[str],
) -> None:
    heart, said = Heartbeat(first_s=0.0, silence_s=0.0), ""
    with heart.watching(["rebuild", "runs/x"]):
        while said.count("\n") < 2:
            said += capsys.readouterr().err
            time.sleep(0.01)
    assert all(line.startswith("rebuild: at work, ") for line in said.splitlines())
    capsys.readouterr()
    with heart.doing(lambda: "works"), heart.doing(None):
        heart.beat()
    assert capsys.readouterr().err == ""

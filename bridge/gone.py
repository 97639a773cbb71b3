"""Commands and flags of earlier editions, each with what to use instead; kept for one release."""

from collections.abc import Sequence

from bridge.errors import UsageError

_TOLD = {
    "sync": "Copy a run with rclone, for example: rclone copy --checksum RUN DEST.",
    "check --wire --seconds --rate-hz --connect --listen": (
        "Record a few seconds, robot-gst record RUN --episode try --duration 5, and check RUN."
    ),
    "export catalogue": "robot-gst ls RUN --json lists all of it.",
    "export rrd": "Write the file with robot-gst view EPISODE --out FILE.rrd.",
    "export corrected": "export csv, tum and lerobot take --clock corrected.",
    "prune": "robot-gst ls RUN --json lists age, size and outcome for a script of yours.",
    "publish folder": "robot-gst import rgbd DIR RUN makes an episode of it.",
    "publish episode": (
        "robot-gst export rosbag2 makes a bag; ros2 bag play sends it, also over rmw_zenoh_cpp."
    ),
    "record --preview-video": "--preview-hz has small pictures sent to whoever watches.",
    "record --quota-mb": "--min-free-mb leaves space on the disk; logrotate removes old runs.",
    "record --split-mb --split-s": "Stop and start another episode; mcap merge joins old parts.",
    "record --triggers --preroll-s --preroll-mb|ctl snapshot": (
        "Record all the time; robot-gst ctl stop --discard throws a take away."
    ),
    "ctl pause|ctl resume": "Stop the episode, and start another one.",
    "ctl list|ctl --last": "robot-gst ls RUN lists what is recorded.",
    "import trials": "robot-gst open TABLE RUN keeps any table of trials in a run.",
    "import kinova": "Run python datasets/kinova/make_episodes.py DIR RUN.",
    "import images": "robot-gst import rgbd reads the same folders.",
    "import splats": "robot-gst rebuild makes scenes; splat viewers open scene/background.ply.",
}
GONE = {
    f"{command} --{flag}" if flag else command: text
    for names, text in _TOLD.items()
    for command, *flags in (each.split(" --") for each in names.split("|"))
    for flag in flags or ("",)
}
"""By command, or by command and flag (``"record --quota-mb"``); each text is a sentence."""


def refuse_gone(tokens: Sequence[str]) -> None:
    """Answer a command or a flag that went."""
    words = [token.partition("=")[0] for token in tokens]
    for command in (" ".join(words[:2]), words[0] if words else ""):
        for name in (command, *(f"{command} {word}" for word in words if word.startswith("--"))):
            if name in GONE:
                raise UsageError(f"{name} is gone. {GONE[name]}")

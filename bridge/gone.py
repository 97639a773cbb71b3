"""Commands and flags of earlier editions, each with what to use instead; kept for one release."""

from collections.abc import Sequence

from bridge.errors import UsageError

_TOLD = {
    "design --width --rate-width": "Give --gain with --rate; at a given size use --starts.",
    "design --agrees-above --agreement": "Use evaluate --fail-under.",
    "sync": "Copy a run with rclone, for example: rclone copy --checksum RUN DEST.",
    "check --wire --seconds --rate-hz --connect --listen": (
        "Record a few seconds, robot-gst record RUN --episode try --duration 5, and check RUN."
    ),
    "check --rerun": "Rerun's own checker is: rerun mcap check --full FILE.",
    "export catalogue": "robot-gst ls RUN --json lists all of it.",
    "export rrd": "Write the file with robot-gst view EPISODE --out FILE.rrd.",
    "export corrected": "export csv, tum and lerobot take --clock corrected.",
    "label --flag --unflag|ls --flagged --no-flagged": "The dashboard's page Label has flags (f).",
    "dashboard --console": "Use robot-gst ctl start and stop, and the dashboard's page label.",
    "prune": "robot-gst ls RUN --json lists age, size and outcome for a script of yours.",
    "export lerobot --depth": "Depth stays in the episodes; robot-gst export tum writes it.",
    "export rosbag2 --json-topics": "JSON records are left out; robot-gst export csv writes them.",
    "export tum --color": "Files stay as recorded; ImageMagick decodes: mogrify -format png *.jpg.",
    "publish folder": "robot-gst import rgbd DIR RUN makes an episode of it.",
    "task new --like": "Copy the file of the other task, and change its name in it.",
    "publish ur --urdf": "Give the file with --robot.",
    "publish realsense --align": "Depth keeps its own camera, whose pose is published too.",
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
    "ls --parquet": "robot-gst ls RUN --json; pandas and DuckDB read its list of episodes.",
    "recover --in-place": "Free some space, or use another disk: a copy is made beside it.",
    "import trials": "robot-gst open TABLE RUN keeps any table of trials in a run.",
    "import kinova": "Run python datasets/kinova/make_episodes.py DIR RUN.",
    "import splats": "robot-gst rebuild makes scenes; splat viewers open scene/background.ply.",
    "rebuild --align-poses --refine-poses --align-holdout": (
        "Poses stay as recorded; --poses odometry or robot-gst calibrate RUN --cameras finds them."
    ),
    "rebuild --correct-geometry": "Import again: import rgbd --depth-unit-m, --depth-intrinsics.",
    "evaluate --live --recorder --connect --goal": (
        "evaluate says how many more trials would likely decide a comparison."
    ),
    "evaluate --axes": "Evaluate the rows of each setting as a table of their own.",
    "evaluate --force": "Delete RUN/results/cache; nothing else remembers a file.",
    "evaluate --lpips-alex": "--lpips-vgg makes LPIPS as papers on splatting compute it.",
    "evaluate --against": "Evaluate each run; trials.csv has the same trials in both.",
    "replay --engines-must-agree|gate --engines-must-agree": (
        "--engine mujoco replays in MuJoCo, after or before pybullet."
    ),
    "replay --relocalise": "Remove derived/*.localised.*.mcap; the next replay makes them anew.",
    "calibrate --evaluations": "--physics reads imported pushes; trials teach through --posterior.",
    "calibrate --pairs": "Record /CELL/cam/ID/target/pose, then robot-gst calibrate RUN --cameras.",
    "calibrate --samples|publish standin --probes": "calibrate RUN --posterior learns of trials.",
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

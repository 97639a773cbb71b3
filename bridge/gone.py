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
    "publish ur --urdf": "Give the file with --robot.",
    "publish realsense --align": "Depth keeps its own camera, whose pose is published too.",
    "publish episode": (
        "robot-gst export rosbag2 makes a bag; ros2 bag play sends it, also over rmw_zenoh_cpp."
    ),
    "record --preview-video": "--preview-hz has small pictures sent to whoever watches.",
    "record --quota-mb": "--min-free-mb leaves space on the disk; logrotate removes old runs.",
    "record --failover": "A failing disk ends the recording; begin anew on another disk.",
    "record --hang-s": "robot-gst ctl status says for how long a disk has not answered.",
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
    "rebuild --features --feature-channels --feature-stride": "Nothing read them; see --clip.",
    "rebuild --depth-model": "rebuild needs depth images: it finds no depth of its own.",
    "rebuild --generator --generator-timeout-s": "Shapes are carved from what the cameras saw.",
    "evaluate --live --recorder --connect --goal": (
        "evaluate says how many more trials would likely decide a comparison."
    ),
    "evaluate --interval|design --interval": "Intervals are Wilson's; results.json has k and n.",
    "evaluate --axes": "Evaluate the rows of each setting as a table of their own.",
    "evaluate --names": "Spell names alike that are one, and others further apart.",
    "design --past": "Say what is expected: --rate, --gain.",
    "design --per-task": "A study asks for its gain over all tasks together.",
    "evaluate --force": "Delete RUN/results/cache; nothing else remembers a file.",
    "evaluate --lpips-alex": "--lpips-vgg makes LPIPS as papers on splatting compute it.",
    "evaluate --against": "Evaluate each run; trials.csv has the same trials in both.",
    "evaluate --masks": "Masks of a run's own views are scored (views.all.psnr_MASK_db).",
    "trials --rate-hz --image-scale": "Pictures of a study are those of the cell file, 5 a second.",
    "share --before-s --after-s": "A clip shows 3 s before the moment of divergence and 2 s after.",
    "render --rate-hz": "One frame is drawn for each recorded image.",
    "replay --grasp|gate --grasp": "A grasp holds by friction, as in life.",
    "replay --engines-must-agree|gate --engines-must-agree": (
        "--engine mujoco replays in MuJoCo, after or before pybullet."
    ),
    "replay --relocalise": "Remove derived/*.localised.*.mcap; the next replay makes them anew.",
    "calibrate --evaluations": "--physics reads imported pushes; trials teach through --posterior.",
    "calibrate --budget": "--physics tries a grid, which takes as long as it takes.",
    "plan --send-images": "A model gets the marked picture of the start; leave the flag out.",
    "calibrate --pairs": "Record /CELL/cam/ID/target/pose, then robot-gst calibrate RUN --cameras.",
    "calibrate --samples|publish standin --probes": "calibrate RUN --posterior learns of trials.",
    "calibrate --max-postures": "Postures are chosen far from each other; their number is fixed.",
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

"""The command ``find``; imports stay late so that --help is quick."""

from pathlib import Path

from bridge.terminal import Output

OUTPUT = Output()


def find(
    run: Path,
    words: str,
    /,
    *,
    clip: Path | None = None,
    output: Output = OUTPUT,
) -> int:
    """Find what words mean in a rebuilt scene: objects and parts, with masks, poses and a picture.

    Exit code 3, and why, where nothing fits. Left and right are as in the picture.
    Example: robot-gst find runs/today "the box's rim"

    Args:
        run: Run folder with a rebuilt scene.
        words: Colours, sizes, nouns, parts, and where: "the red cube left of the box".
        clip: Folder of CLIP, where the scene was rebuilt with it; without, a lexicon answers.
    """
    import numpy as np

    from bridge.episode.run_folder import RunFolder
    from bridge.media.color import encode_png
    from bridge.whole_file import write_whole
    from twin.naming.phrases import Asker
    from twin.scene.foundation.find import about, line_of, look_at, meaning_of, picture_of

    folder = RunFolder.open(run)
    looked = look_at(folder)
    asker = Asker(
        scene=looked.scene,
        T_base_camera=looked.best.T_base_camera,
        meaning=None if clip is None else meaning_of(folder, looked.scene, clip),
    )
    answer = asker.find(words)
    path = folder.results_dir / "find.png"
    data = {"words": words, "found": [about(item) for item in answer.found], "why": answer.why}
    if answer.found:
        view = looked.view_of(answer)
        mask = path.with_name(f"{path.stem}_mask.png")
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, encode_png(picture_of(view, answer)))
        write_whole(mask, encode_png(view.numbers(answer).astype(np.uint8)))
        data |= {"picture": str(path), "mask": str(mask), "camera": view.name}
    lines = [line_of(number, item) for number, item in enumerate(answer.found, start=1)]
    lines += [str(data[key]) for key in ("picture", "mask") if key in data]
    output.result(data, "\n".join(lines) or f"no such thing: {answer.why}")
    return 0 if answer.found else 3

"""Stands in for SAM 3D Objects: obeys the contract, or breaks it in a named way.

Called as ``python generator_worker.py BEHAVIOUR SOURCE in.npz out``; SOURCE holds the known shape.
"""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path


def obey(source: Path, given: Path, out: Path) -> None:
    """Put the known shape roughly where the point map says the object is."""
    import numpy as np

    with np.load(given) as content:
        points, mask = content["pointmap"][content["mask"]], content["mask"]
        assert content["rgb"].shape == (*mask.shape, 3)
        assert content["K"].shape == (3, 3)
        assert int(content["seed"]) == 42
        row, column = np.argwhere(mask).mean(axis=0) + 0.5
        fx, cx, cy = content["K"][0, 0], content["K"][0, 2], content["K"][1, 2]
    points = points[np.isfinite(points).all(axis=1)]
    middle = points.mean(axis=0)
    # x left and y up: what stands right of the centre has negative x, what stands below negative y.
    assert abs(middle[0] / middle[2] + (column - cx) / fx) < 0.1
    assert abs(middle[1] / middle[2] + (row - cy) / fx) < 0.1
    pose = json.loads((source / "pose.json").read_text())
    pose["translation"] = middle.tolist()
    for name in ("mesh.glb", "splat.ply"):
        shutil.copy(source / name, out / name)
    (out / "pose.json").write_text(json.dumps(pose))


def main() -> None:
    behaviour, source, given, out = sys.argv[1], *(Path(word) for word in sys.argv[2:])
    print("first words", "x" * 5000, file=sys.stderr)
    print(f"the {behaviour} worker speaks", file=sys.stderr, flush=True)
    if behaviour == "crash":
        raise RuntimeError("out of memory on the GPU")
    if behaviour == "exit":
        sys.exit(7)
    if behaviour == "signal":
        os.abort()
    if behaviour == "hang":
        sleeper = "import time; time.sleep(60)"
        child = subprocess.Popen([sys.executable, "-c", sleeper])
        (source / "child").write_text(str(child.pid))
        time.sleep(60)
    if behaviour == "huge":
        with (out / "mesh.glb").open("wb") as stream:
            for _ in range(1000):
                stream.write(bytes(1_000_000))
                stream.flush()
                time.sleep(0.01)
    if behaviour == "nothing":
        return
    obey(source, given, out)
    if behaviour == "without_splat":
        (out / "splat.ply").rename(out / "splats.ply")
    if behaviour == "link":
        (out / "mesh.glb").unlink()
        (out / "mesh.glb").symlink_to(source / "mesh.glb")
    if behaviour == "replaced_folder":
        out.rename(source / "moved")
        out.symlink_to(source / "moved")


if __name__ == "__main__":
    main()

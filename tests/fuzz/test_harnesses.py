"""Each harness runs for a few seconds: nothing but ``GstError``, no hang, bounded memory."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

HARNESS = Path(__file__).with_name("harness.py")
ROOT = HARNESS.parents[2]
SECONDS = int(os.environ.get("GST_FUZZ_S", "1"))
"""``make soak`` feeds each for half a minute."""


@pytest.mark.slow
@pytest.mark.parametrize("target", ["read", "recover", "cdr", "attachment", "depth", "checksum"])
def test_bytes_of_a_fuzzer_do_no_harm(tmp_path: Path, target: str) -> None:
    pytest.importorskip("atheris", reason="atheris is not installed on this platform")
    command = [sys.executable, str(HARNESS), target, str(tmp_path / "corpus")]
    options = [f"-max_total_time={SECONDS}", "-timeout=10", "-rss_limit_mb=1500"]
    paths = filter(None, [os.environ.get("PYTHONPATH"), str(ROOT)])  # make sanitize names a folder
    done = subprocess.run(
        [*command, *options, f"-artifact_prefix={tmp_path}/"],
        cwd=ROOT,
        env={**os.environ, "TMPDIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
        errors="replace",
        timeout=120 + 2 * SECONDS,
        check=False,
    )
    assert done.returncode == 0, (done.stdout + done.stderr)[-3000:]
    assert "Done " in done.stderr

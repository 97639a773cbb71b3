"""docs/wire.md, kept by a publisher that knows nothing of us, and broken in every way there is."""

import ast
import shutil
import struct
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from patience import wait_until

from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.cdr.messages import JointSample
from bridge.episode.check import check_episode
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.record.recorder import Recorder
from bridge.wire.publisher import Attachment, encode
from bridge.wire.session import WireSession

ROOT = Path(__file__).resolve().parents[3]
EXAMPLES = ROOT / "docs" / "examples" / "zenoh"
PYTHON = EXAMPLES / "publish_joints.py"
JOINTS = "/demo/joint_states"
WAIT_S = 20.0


Spawn = Callable[..., "subprocess.Popen[str]"]


def test_the_example_knows_nothing_of_us_and_is_short() -> None:
    tree = ast.parse(PYTHON.read_text())
    names = {
        alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
    }
    assert names == {"json", "math", "struct", "sys", "time", "uuid", "zenoh"}
    paths = [*EXAMPLES.glob("publish_joints.*"), *EXAMPLES.glob("joint_bytes.*")]
    assert len(paths) == 6
    for path in paths:
        assert len(path.read_text().splitlines()) <= 100, path.name


C_MAIN = """
#include <stdio.h>
#include "joint_bytes.h"
static void show(const uint8_t* data, size_t length) {
    for (size_t i = 0; i < length; i++) printf("%02x", data[i]);
    printf("\\n");
}
int main() {
    uint8_t gid[16], out[256];
    const double position_rad[3] = {0.5, -0.5, 0};
    for (int i = 0; i < 16; i++) gid[i] = (uint8_t)i;
    show(out, attachment(out, -7, 1700000000123456789, gid));
    show(out, joint_state(out, 1700000000123456789, position_rad));
}
"""
RUST_MAIN = """
#[path = "EXAMPLES/joint_bytes.rs"] mod joint_bytes;
fn show(data: Vec<u8>) {
    println!("{}", data.iter().map(|b| format!("{b:02x}")).collect::<String>());
}
fn main() {
    let gid: [u8; 16] = std::array::from_fn(|i| i as u8);
    show(joint_bytes::attachment(-7, 1700000000123456789, &gid));
    show(joint_bytes::joint_state(1700000000123456789, [0.5, -0.5, 0.0]));
}
"""
COMPILERS = {
    "c": ["gcc", "-std=c11", "-Wall", "-Wextra", "-Werror", f"-I{EXAMPLES}", "main.c"],
    "cpp": ["g++", "-std=c++17", "-Wall", "-Wextra", "-Werror", f"-I{EXAMPLES}", "main.cpp"],
    "rs": ["rustc", "main.rs"],
}


@pytest.mark.parametrize("language", COMPILERS)
def test_the_bytes_of_every_language_are_the_same(tmp_path: Path, language: str) -> None:
    command = COMPILERS[language]
    if shutil.which(command[0]) is None:
        pytest.skip(f"{command[0]} is not here")
    text = RUST_MAIN.replace("EXAMPLES", str(EXAMPLES)) if language == "rs" else C_MAIN
    (tmp_path / f"main.{language}").write_text(text)
    made = subprocess.run(
        [*command, "-o", "program"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    if language == "rs" and "linker" in made.stderr:
        pytest.skip("rustc has no linker here")
    assert made.returncode == 0, made.stderr
    out = subprocess.run(
        [str(tmp_path / "program")], capture_output=True, text=True, check=True
    ).stdout
    note, message = (bytes.fromhex(line) for line in out.split())
    stamp_ns = 1_700_000_000_123_456_789
    assert note == encode(Attachment(sequence=-7, source_ns=stamp_ns, gid=bytes(range(16))))
    joints = JointSample.from_cdr(message)
    assert (joints.stamp_ns, joints.names) == (stamp_ns, ("shoulder", "elbow", "wrist"))
    assert joints.position.tolist() == [0.5, -0.5, 0.0]
    assert codec.encode(schema.JOINT_STATE, codec.decode(schema.JOINT_STATE, message)) == message


@pytest.mark.parametrize("left_out", [(), (7, 8, 20)])
def test_the_example_is_recorded_clean_and_its_losses_are_seen_exactly(
    router: WireSession, endpoint: str, run: RunFolder, spawn: Spawn, left_out: tuple[int, ...]
) -> None:
    recorder = Recorder(run, now_ns=router.now_ns)
    router.subscribe("**", recorder.receive)
    recorder.start(EpisodeInfo(id="t1", kind="trial", cell="demo"))
    publisher = spawn(str(PYTHON), endpoint, "demo", "60", "1000", *map(str, left_out))
    _, said = publisher.communicate(timeout=WAIT_S)
    assert publisher.returncode == 0, said
    wait_until(lambda: recorder.input_queue.seen().get(JOINTS, 0) == 60 - len(left_out))
    answer = recorder.stop()
    recorder.close()
    assert (answer["messages"], answer["lost"]) == (60 - len(left_out), len(left_out))
    assert answer["undecodable"] == 0
    path = run.episodes_dir / "t1.mcap"
    report = check_episode(path)
    assert report.exit_code == (3 if left_out else 0), report.lines()
    messages = list(Episode.open(path).messages([JOINTS]))
    assert [each.sequence for each in messages] == [n for n in range(60) if n not in left_out]
    for each in messages:
        sec, nanosec = struct.unpack_from("<iI", each.data, 4)
        assert each.publish_time_ns == sec * 10**9 + nanosec
        assert each.type_name == schema.JOINT_STATE

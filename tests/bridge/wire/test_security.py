"""The documented configuration files at work: what they forbid does not get through."""

import contextlib
import ipaddress
import json
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from own_process import begun
from patience import wait_until

from bridge.episode import schema
from bridge.record.control import RecorderClient
from bridge.wire.config import WireConfig
from bridge.wire.errors import NoPeerError, NoReplyError
from bridge.wire.session import WireSample, WireSession, open_session

ROOT = Path(__file__).resolve().parents[3]
EXAMPLES = ROOT / "docs" / "examples" / "zenoh"
PEOPLE = ("recorder", "cell", "camera", "operator", "gate", "robot", "stranger")
REFUSED_S = 0.5
"""Whoever is let in is let in sooner; zenoh goes on knocking until its time is over."""
Authority = tuple[ec.EllipticCurvePrivateKey, x509.Certificate]


def certify(folder: Path, name: str, authority: Authority | None) -> Authority:
    """Write ``<name>.pem`` and ``<name>.key``; without an authority it is one itself."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    made = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject if authority is None else authority[1].subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(datetime(2020, 1, 1, tzinfo=UTC))
        .not_valid_after(datetime(2100, 1, 1, tzinfo=UTC))
        .add_extension(x509.BasicConstraints(ca=authority is None, path_length=None), critical=True)
        .add_extension(
            x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]),
            critical=False,
        )
        .sign(key if authority is None else authority[0], hashes.SHA256())
    )
    pem = serialization.Encoding.PEM
    (folder / f"{name}.pem").write_bytes(made.public_bytes(pem))
    plain = serialization.NoEncryption()
    (folder / f"{name}.key").write_bytes(
        key.private_bytes(pem, serialization.PrivateFormat.PKCS8, plain)
    )
    return key, made


@pytest.fixture(scope="session")
def pki(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Certificates and the documented configuration files that use them."""
    folder = tmp_path_factory.mktemp("pki")
    authority = certify(folder, "ca", None)
    for name in PEOPLE:
        certify(folder, name, authority)
    foreign = tmp_path_factory.mktemp("foreign")
    certify(folder, "forged", certify(foreign, "ca", None))
    recorder = (EXAMPLES / "recorder.json5").read_text()
    recorder = recorder.replace("size_limit: 200000000", "size_limit: 2000000")
    files = {"recorder": recorder}
    for name in ("cell", "operator"):
        files[name] = (EXAMPLES / f"{name}.json5").read_text()
    for name in ("camera", "gate", "robot", "stranger", "forged"):
        files[name] = files["cell"].replace("/cell.", f"/{name}.")
    files["nobody"] = (
        f'{{transport: {{link: {{tls: {{root_ca_certificate: "{folder}/ca.pem"}}}}}}}}'
    )
    for name, text in files.items():
        (folder / f"{name}.json5").write_text(text.replace("/etc/robot-gst", str(folder)))
    return folder


@pytest.fixture
def tls(endpoint: str) -> str:
    return endpoint.replace("tcp/", "tls/")


@pytest.fixture
def guarded(pki: Path, tls: str) -> Iterator[WireSession]:
    config = WireConfig(mode="router", connect=(), listen=(tls,), config=pki / "recorder.json5")
    with open_session(config) as session:
        yield session


@pytest.fixture
def join(pki: Path, tls: str, guarded: WireSession) -> Iterator[Callable[[str], WireSession]]:
    with contextlib.ExitStack() as stack:

        def open_as(name: str) -> WireSession:
            path = pki / f"{name}.json5"
            timeout_s = REFUSED_S if name in ("nobody", "forged") else 5.0
            config = WireConfig(connect=(tls,), config=path, connect_timeout_s=timeout_s)
            return stack.enter_context(open_session(config))

        yield open_as


def arrived(got: list[WireSample], topic: str, within_s: float = 5.0) -> bool:
    end_s = time.monotonic() + within_s
    while time.monotonic() < end_s:
        if any(sample.topic == topic for sample in got):
            return True
        time.sleep(0.01)
    return False


def send_all(session: WireSession, *topics: str) -> None:
    """Publish on each, past every politeness of our own publisher."""
    for topic in topics:
        session._inner.put(topic[1:], b"x" * 100)


@pytest.mark.parametrize("name", ["nobody", "forged"])
def test_without_a_certificate_of_ours_nobody_gets_in(
    join: Callable[[str], WireSession], name: str
) -> None:
    with pytest.raises(NoPeerError, match="it may want a certificate"):
        join(name)


@pytest.mark.parametrize(
    ("name", "allowed"),
    [
        ("cell", {"/lab/joint_states", "/lab/cam/a/color/image", "/tf"}),
        ("camera", {"/lab/cam/a/color/image"}),
        ("operator", set()),
        ("stranger", set()),
    ],
)
def test_everybody_writes_only_what_is_theirs(
    guarded: WireSession, join: Callable[[str], WireSession], name: str, allowed: set[str]
) -> None:
    got: list[WireSample] = []
    guarded.subscribe("**", got.append)
    witness, session = join("cell"), join(name)
    tried = ("/lab/joint_states", "/lab/cam/a/color/image", "/tf", "/rec/main/status", "/other")
    send_all(session, *tried)
    for topic in allowed:
        assert arrived(got, topic), f"{name} could not send {topic}"
    send_all(witness, "/lab/last")
    assert arrived(got, "/lab/last")
    time.sleep(0.2)
    assert {sample.topic for sample in got} - {"/lab/last"} == allowed


def test_only_the_operator_controls_the_recorder(
    guarded: WireSession, join: Callable[[str], WireSession]
) -> None:
    asked: list[bytes] = []

    def answer(payload: bytes) -> bytes:
        asked.append(payload)
        return b'{"ok": true}'

    guarded.serve("rec/main/ctl/stop", answer)
    assert RecorderClient(join("operator"), timeout_s=5.0).ask("stop") == {"ok": True}
    for name in ("camera", "cell", "stranger"):
        with pytest.raises(NoReplyError):
            RecorderClient(join(name), timeout_s=REFUSED_S).ask("stop")
    assert len(asked) == 1


def test_a_stranger_reads_nothing(guarded: WireSession, join: Callable[[str], WireSession]) -> None:
    overheard: list[WireSample] = []
    join("stranger").subscribe("**", overheard.append)
    join("camera").subscribe("**", overheard.append)
    got: list[WireSample] = []
    guarded.subscribe("lab/**", got.append)
    send_all(join("cell"), "/lab/joint_states")
    assert arrived(got, "/lab/joint_states")
    time.sleep(0.3)
    assert overheard == []


@pytest.mark.parametrize("shared_memory_mb", [0, 16])
def test_a_huge_message_is_stopped_at_the_door(
    pki: Path, guarded: WireSession, tls: str, shared_memory_mb: int
) -> None:
    got: list[WireSample] = []
    guarded.subscribe("**", got.append)
    config = WireConfig(
        connect=(tls,), config=pki / "cell.json5", shared_memory_mb=shared_memory_mb
    )
    with open_session(config) as session:
        image = session.publisher("/lab/cam/a/depth/image", schema.IMAGE)
        wait_until(image.has_subscribers)
        image.put(bytes(3_000_000), source_ns=1)
        image.put(bytes(1_500_000), source_ns=2)
        assert arrived(got, "/lab/cam/a/depth/image")
    time.sleep(0.2)
    assert [(len(sample.data), sample.sequence) for sample in got] == [(1_500_000, 1)]


@pytest.mark.slow
def test_the_commands_take_the_documented_files(pki: Path, tls: str, tmp_path: Path) -> None:
    def status_as(name: str) -> tuple[int, str]:
        asking = ("--connect", tls, "--config", str(pki / f"{name}.json5"), "--json")
        child = begun("robot_gst.py", "ctl", "status", *asking)
        out, err = child.communicate(timeout=60.0)
        return child.returncode, out if child.returncode == 0 else err

    listening = ("--listen", tls, "--config", str(pki / "recorder.json5"))
    recorder = begun("robot_gst.py", "record", str(tmp_path / "run"), *listening)
    try:
        end_s = time.monotonic() + 60.0
        while (answer := status_as("operator"))[0] != 0:
            assert time.monotonic() < end_s, answer
        assert json.loads(answer[1])["state"] == "idle"
        code, err = status_as("camera")
        assert code == 1
        assert "nobody answered on rec/main/ctl/status" in err
        code, err = status_as("nobody")
        assert code == 1
        assert "it may want a certificate" in err
    finally:
        recorder.terminate()
        _, err = recorder.communicate(timeout=60.0)
    assert recorder.returncode == 0, err
    assert "Traceback" not in err

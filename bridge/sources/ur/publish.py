"""Publishes a UR arm: reads its controller for as long as it takes, and comes back to it."""

import threading
from pathlib import Path
from typing import Any

from bridge.episode import schema
from bridge.episode.message import StampedMessage
from bridge.episode.records import string_to_cdr
from bridge.errors import PathNotFoundError, UsageError
from bridge.sources.announcer import Announcer
from bridge.sources.ur.arm import ArmPublisher, wish_of
from bridge.sources.ur.client import RtdeClient
from bridge.sources.ur.config import UrConfig
from bridge.sources.ur.errors import ControllerError
from bridge.task.robot import ur5_urdf, ur5_with_gripper_urdf
from bridge.terminal import Output
from bridge.wire.session import WireSession

RETRY_S = 1.0


def publish_arm(
    session: WireSession,
    host: str,
    config: UrConfig,
    *,
    stop: threading.Event,
    output: Output,
) -> dict[str, Any]:
    """Publish the arm until stopped.

    Args:
        session: An open session.
        host: Name or address of the controller.
        config: What is read, and how it is named.
        stop: Asked between samples.
        output: Told what happens to the connection.

    Returns:
        Samples sent, samples that did not reach us, and connections made.

    Raises:
        ControllerError: When the first connection fails; later ones are tried again.
    """
    urdf = read_urdf(config)
    client: RtdeClient | None = _connect(session, host, config, output)
    announcer = Announcer(session)
    if urdf is not None:
        announcer.fact("urdf", _description(urdf, session.now_ns()))
    arm = ArmPublisher(session, config, announcer)
    connections = 1
    try:
        while client is not None:
            arm.begin(client.rate_hz)
            _read(client, arm, stop=stop, output=output)
            client = _connect_again(session, host, config, stop=stop)
            if client is not None:
                connections += 1
                output.say(f"{host}: the controller is back")
    finally:
        announcer.close()
    if announcer.failure is not None:
        raise announcer.failure
    return {**arm.counts(), "connections": connections}


def describe_counts(counts: dict[str, Any]) -> str:
    """One line for people."""
    return (
        f"{counts['samples']} samples sent, {counts['lost']} lost before they got here, "
        f"{counts['connections']} connection{'s' if counts['connections'] != 1 else ''}"
    )


def read_urdf(config: UrConfig) -> str | None:
    """The robot's description: a file, a UR5 from the data package, or none.

    Raises:
        PathNotFoundError: When the file is not there.
        MissingDependencyError: When the UR5's data package is not installed.
    """
    if config.urdf is not None:
        return _read_urdf_file(config.urdf)
    if config.robot == "none":
        return None
    return ur5_with_gripper_urdf() if config.robot == "ur5_parallel_gripper" else ur5_urdf()


def _read_urdf_file(path: Path) -> str:
    if not path.is_file():
        raise PathNotFoundError(path=path, what="URDF file", hint="Check --urdf.")
    try:
        text = path.read_text()
    except UnicodeDecodeError as error:
        raise UsageError(f"{path} is not a text file ({error.reason}).") from error
    if "<robot" not in text:
        raise UsageError(f"{path} holds no <robot>; it must be a URDF (expand xacro files first).")
    return text


def _description(urdf: str, stamp_ns: int) -> StampedMessage:
    return StampedMessage(
        topic="/robot_description",
        type_name=schema.STRING,
        data=string_to_cdr(urdf),
        stamp_ns=stamp_ns,
    )


def _connect(session: WireSession, host: str, config: UrConfig, output: Output) -> RtdeClient:
    def on_text(text: str) -> None:
        output.detail(f"{host} says: {text}")

    client = RtdeClient(host, config.port, wish_of(config), now_ns=session.now_ns, on_text=on_text)
    version = ".".join(map(str, client.version))
    output.say(f"{host}: controller {version}, {client.rate_hz:g} samples a second")
    if client.missing:
        output.say(f"{host}: the controller does not know {', '.join(client.missing)}; left out")
    return client


def _connect_again(
    session: WireSession, host: str, config: UrConfig, *, stop: threading.Event
) -> RtdeClient | None:
    """Try until the controller is back or everything is stopped."""
    quiet = Output(quiet=True)
    while not stop.wait(RETRY_S):
        try:
            return _connect(session, host, config, quiet)
        except ControllerError:
            continue
    return None


def _read(client: RtdeClient, arm: ArmPublisher, *, stop: threading.Event, output: Output) -> None:
    """Publish what one connection brings, until it ends."""
    try:
        for sample in client.samples():
            missing = arm.put(sample)
            if missing:
                output.detail(f"{missing} samples missing at {sample.robot_s:.3f} s of the robot")
            if stop.is_set():
                return
    except ControllerError as error:
        output.say(f"{error} Trying again every second.")
    finally:
        client.close()

"""Passwords and keys of configuration files and endpoints are in no error."""

from pathlib import Path

import pytest

from bridge.errors import GstError
from bridge.wire.config import WireConfig
from bridge.wire.errors import NoPeerError, PortTakenError, WireConfigError
from bridge.wire.session import WireSession, open_session

SECRET = "hunter2secret"
USER = "transport: {auth: {usrpwd: {user: 'u', password: "


def everything_said(error: BaseException | None) -> str:
    """The error and all that a traceback would show with it."""
    said = []
    while error is not None:
        said.append(f"{error}")
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
    return "\n".join(said)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (f"{{{USER}'{SECRET}}}}}}}}}", "line 1, column"),
        (f"{{\n{USER}\n'{SECRET}' oops}}}}}}}}", "line 3, column"),
        (f"{{transport: {{auth: {{usrpwd: '{SECRET}'}}}}}}", "line 1: invalid type: string, exp"),
        (f"{{{USER}['{SECRET}']}}}}}}}}", "invalid type: sequence"),
        ("{" + USER + "31337}}}}", "invalid type: integer, expected a string"),
        (f"{{transport: {{link: {{tls: {{enable_mtls: '{SECRET}'}}}}}}}}", "expected a boolean"),
        (f'{{transport: {{link: {{tls: {{enable_mtls: "a\\"{SECRET}"}}}}}}}}', "invalid type"),
    ],
)
def test_a_configuration_file_is_not_quoted(tmp_path: Path, text: str, match: str) -> None:
    path = tmp_path / "zenoh.json5"
    path.write_text(text)
    with pytest.raises(WireConfigError, match=match) as caught:
        open_session(WireConfig(config=path))
    assert SECRET not in everything_said(caught.value)
    assert "31337" not in everything_said(caught.value)


def test_settings_of_an_endpoint_are_not_shown(
    router: WireSession, endpoint: str, tmp_path: Path
) -> None:
    settings = f"#connect_private_key_base64={SECRET}"
    cases: list[tuple[type[GstError], WireConfig]] = [
        (NoPeerError, WireConfig(connect=(f"tls/127.0.0.1:1{settings}",), connect_timeout_s=0.2)),
        (
            PortTakenError,
            WireConfig(mode="router", connect=(), listen=(f"{endpoint}{settings}",)),
        ),
        (WireConfigError, WireConfig(connect=(f"127.0.0.1:1{settings}",))),
    ]
    for kind, config in cases:
        with pytest.raises(kind) as caught:
            open_session(config)
        assert SECRET not in str(caught.value)

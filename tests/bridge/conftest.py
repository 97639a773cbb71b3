"""Commands in processes of their own, which end with their test."""

import subprocess
from collections.abc import Callable, Iterator

import pytest
from own_process import begun


@pytest.fixture
def spawn() -> Iterator[Callable[..., "subprocess.Popen[str]"]]:
    children: list[subprocess.Popen[str]] = []

    def start(*arguments: str) -> "subprocess.Popen[str]":
        children.append(begun(*arguments))
        return children[-1]

    yield start
    for child in children:
        if child.poll() is None:
            child.kill()
        child.communicate()

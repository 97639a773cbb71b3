"""PyBullet without the line about its build that it prints on standard error when imported."""

import importlib
import os
from types import ModuleType


def _import_quietly() -> ModuleType:
    saved = os.dup(2)
    silence = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(silence, 2)
        return importlib.import_module("pybullet")
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(silence)


pybullet = _import_quietly()

ENGINE = "pybullet"
ENGINE_VERSION = f"{ENGINE}-{pybullet.getAPIVersion()}"

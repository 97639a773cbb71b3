"""The front door: the command ``robot-gst``, which only lists the commands of the rooms."""

import sys

from cyclopts import App

app = App(name="robot-gst", help="Record a robot cell, rebuild it, re-live every plan, and say how far the twin can be trusted.")

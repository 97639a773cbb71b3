import robot_gst


def run(*arguments: object) -> int:
    """Run a command of ours in this process; its exit code."""
    return robot_gst.run([str(item) for item in arguments])

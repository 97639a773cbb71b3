"""Follow a session while it is recorded: stop or continue after every trial, and what to run next.

The run folder is what counts; the recorder's messages only bring a trial sooner.
"""

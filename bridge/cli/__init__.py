"""Commands of the room ``bridge``, lazily imported; imports stay late so that --help is quick."""

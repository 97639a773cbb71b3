"""Commands of the room ``bridge``; imports stay late so that --help is quick."""

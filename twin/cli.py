"""Commands of the room ``twin``; imports stay late so that --help is quick."""

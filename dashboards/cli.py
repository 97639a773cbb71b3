"""Commands of the room ``dashboards``; imports stay late so that --help is quick."""

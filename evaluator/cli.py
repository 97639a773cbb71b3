"""Commands of the room ``evaluator``; imports stay late so that --help is quick."""

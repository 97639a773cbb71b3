"""Commands of the package ``bridge``; their imports stay late so that --help is quick."""

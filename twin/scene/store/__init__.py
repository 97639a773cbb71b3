"""The scene folder and the files in it."""

"""What things are called: words, colours, and the names that a rebuilt scene keeps."""

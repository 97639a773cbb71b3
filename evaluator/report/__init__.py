"""Tables, figures and files; computes nothing."""

"""Relations that a plan should keep: closed kinds, evaluated over many states, told in words."""

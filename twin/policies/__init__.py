"""Policies in the loop: the twin as an environment, and rollouts of served or imported policies."""

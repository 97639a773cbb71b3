"""Propose, have it judged, and change what the failing clause asks for."""

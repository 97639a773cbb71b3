"""The stand-in cell: a simulated laboratory that publishes on the wire like a real one."""

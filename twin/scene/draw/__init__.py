"""Pictures of a scene, in the state it was scanned in or another."""

"""From words to a verified trajectory: constraints, grasps, releases, paths, and steering."""

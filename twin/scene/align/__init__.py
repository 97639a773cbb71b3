"""Where the robot of a description stands in a scene, found from depth images that show it."""

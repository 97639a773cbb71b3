"""From waypoints or recorded joints to a path, and what physics answers to it."""

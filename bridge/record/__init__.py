"""Record what comes over zenoh: queue, drop log, episode recording, control."""

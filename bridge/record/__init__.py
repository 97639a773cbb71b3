"""From the wire to the episode: queue, ledger of losses, lifecycle, control."""

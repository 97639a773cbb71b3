"""All trajectories of a run: what is replayed, and the tables of what came out."""

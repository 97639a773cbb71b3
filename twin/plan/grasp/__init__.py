"""Where a hand can take hold of an object, and how sure that is."""

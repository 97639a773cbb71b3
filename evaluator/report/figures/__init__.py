"""One module per subject: it chooses numbers, puts them in a table, and says how to draw them."""

"""What recorded episodes say about the cell: where its cameras are."""

"""What one recording is: schema, reader, writer, check, provenance, catalogue."""

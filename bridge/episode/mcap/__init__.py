"""The file format: chunks and records, written, read, merged and scanned."""

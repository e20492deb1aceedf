"""Value types and mathematics, without file access and logging."""

"""Values and mathematics: numpy only, no files, no logging."""

"""One impact: its pulse, its peaks, its rebound."""

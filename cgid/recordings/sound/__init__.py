"""WAV, FLAC and OGG files, and live streams of samples."""

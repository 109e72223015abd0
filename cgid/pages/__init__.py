"""Pages in a browser on this machine: their server, its checks, and what they share to draw."""

__all__ = ["http", "server"]

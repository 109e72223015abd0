"""Recordings of many rocks that come in a stream: when they arrive, how they bounce, what is recorded of them."""

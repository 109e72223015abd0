"""`cgid label`: a page in the browser in which impacts are labelled, and what the labels are worth."""

__all__ = ["learning", "page", "recording", "table"]

"""Models from one's own labelled recordings: manifest, measuring, choosing and judging by groups left out."""

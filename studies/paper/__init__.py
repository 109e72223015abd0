"""The figures and tables of Yang, Zeng & Wan (2018), recomputed: `python -m studies.paper -o paper`."""

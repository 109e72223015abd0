"""Reports: what a recording is, what was found in it, with pictures, as one page that needs nothing else."""

from cgid.report.content import Report, model_facts, recording_facts
from cgid.report.page import ENDINGS, report_page, write_report

__all__ = ["ENDINGS", "Report", "model_facts", "recording_facts", "report_page", "write_report"]

"""The report of the loop: report.json, report.html and the figures."""

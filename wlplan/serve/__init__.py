"""A process that keeps models and programs warm and answers over HTTP; the page that uses it.

`app.py` puts the `endpoints/` together, each in a file of its own. Requests bring settings
(`settings.py`) and scans (`uploads.py`), what computes goes through one `desk.py`, and `guards.py`
stands before all of it. The work itself is that of the command line: `wlplan.report.making`.
"""

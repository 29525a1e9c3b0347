"""Operators of the window, one file per task of the user: they read properties, call `addon` and `core`, and report.

An operator is a class `MPHDRR_OT_...`, found without a list. Its docstring is the tooltip; its `bl_idname` follows from its
class's name (`ids.operator_name`), and so does its `bl_label` unless the class has one (`ids.label`); `registration.py` sets
them. Quick work derives from `reports.Reported` (`act` returns the message), long work from `jobs.JobOperator` (`job`
returns the job that runs beside the window), a file to write from `jobs.ExportJob`.

To add an operator, write its class in the file of its task, the function that does the work in `addon`, and a line in
`panels/menus.py`.
"""

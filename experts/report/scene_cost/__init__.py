"""What a scene leaves out: the cost of scenes, of their parts, of unused outputs, and of the installation.

`measurement.measure` makes a `SceneCostReport` of plain data; `records.report_record` turns it into JSON's
types and `tables.tables` into tables. A part that a scene does not have leaves its machine code smaller and
faster; a program that nobody calls is never compiled; a package that nothing uses is never imported.
"""

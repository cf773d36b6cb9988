"""All reports on one page: each part yields a section, which is written as HTML and as Markdown.

sections    what a section is: caption, tables, printed text, figures, and what is less accurate than declared
parts       the parts: error against run time, what scenes leave out, the expert, throughput
rendering   a self-contained HTML page, and Markdown with its pictures beside it
"""

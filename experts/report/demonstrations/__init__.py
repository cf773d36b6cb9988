"""What a data set of demonstrations is worth: its numbers, a page with pictures, and a data card.

facts       the numbers of every demonstration and failure, and what the log says about times
tables      distributions, guesses, times and failures as tables
sections    the page's sections
card        a data card from a template
writing     the files, in the folder of the data
"""

from experts.report.demonstrations.card import data_card
from experts.report.demonstrations.facts import Facts, gather
from experts.report.demonstrations.writing import write_summary

__all__ = ["Facts", "data_card", "gather", "write_summary"]

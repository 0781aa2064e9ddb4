"""`make reproduce-figures`: what the two ChainQueen papers show, from the command line, with a verdict each.

figure.py    what a figure is: its work, its table, its picture, its verdict
work.py      what takes time: runs of cqrun, and measurements; each goes on where it stopped
figures/     one module a figure; families share a module whose name says what they draw
catalogue.py all of them, in the papers' order
page.py      index.html
"""

"""`make reproduce-figures`: what the two ChainQueen papers show, from the command line, with a verdict each.

figure.py    what a figure is: its work, its table, its picture, its verdict
figures/     one module a figure
families/    what figures of one kind share
machinery/   what does the work, and publishes what came of it
catalogue.py all figures, in the papers' order
"""

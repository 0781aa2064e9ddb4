"""`make reproduce-figures`: what the two ChainQueen papers show, from the command line, with a verdict each.

figure.py    what a figure is: its work, its table, its picture, its verdict
work.py      what takes time: runs of cqrun, and measurements; each goes on where it stopped
turns.py     which of it runs when, side by side or alone; process.py runs a command for so long
rebuild.py   what `make` does: the work in turn, each figure when its own has ended
figures/     one module a figure; families share a module whose name says what they draw
catalogue.py all of them, in the papers' order
train_ppo.py the learner that needs torch, in a process of its own
page.py      index.html
"""

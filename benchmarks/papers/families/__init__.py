"""What figures of one kind share: their table, their picture and their verdict.

distances.py   how far a robot walks, against the iteration (CQ2 Figs 6 to 9)
ablations.py   which material parameters help a walker (CQ2 Figs 11 to 14)
violations.py  how far constraints are violated, against the iteration (CQ1 Fig 8, CQ2 Fig 10)
frames.py      frames of a motion side by side (CQ1 Figs 3, 4 and 6)
learners.py    the gradient beside CMA-ES and PPO (CQ1 Fig 7 and V-B); train_ppo.py trains PPO
histories.py   what runs have recorded: histories and observables
integrity.py   whether a body holds together
"""

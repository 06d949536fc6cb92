"""What any learner needs: the data in memory, a loop, run folders, a race of seeds, predictions.

`method.py` says what a learner must be. `commands.py` has what the command line and notebooks call.
`evaluation/` judges and draws what was learned, in numpy alone. A method is a folder, like `ppd/`,
or another package; nothing else here knows it.
"""

"""What any learner needs: the data in memory, a loop, run folders, a race of seeds, predictions.

`evaluation/` judges and draws what was learned, in numpy alone; a method is a folder, like `ppd/`.
"""

"""The paper's own four estimators of AOMotion, to compare ours with. [paper 4.2]"""

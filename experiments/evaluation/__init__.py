"""Recall and time of pose methods on the same crops: cases, methods, predictions, scores, report."""

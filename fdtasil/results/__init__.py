"""What came of it: the evaluation beside the expert, figures, and the folder of a result."""

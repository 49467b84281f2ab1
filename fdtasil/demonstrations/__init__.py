"""What is learnt from: who acts in which round, labelled states, and their files."""

"""Where else the expert is asked, how its answers are differenced, and how far away.

Every design lowers to the same small thing: a bank of displacements and, for each state, the
numbers of the rows of the bank that it is probed along. Nothing else knows which design it was.
"""

"""The judge's map at an answer, differentiated, with a factor: for derivatives and states of blocks."""

"""The record of many sessions: an index of their files, and what has changed in it.

index       SQLite index of the sessions in a tree of folders; the files stay the truth
changes     which units drift, and which benches are off
report      answers from the index
reidentify  sessions identified again
spread      work spread over many cores or computers
"""

"""Reading and writing files: settings in YAML, tables, atomic writes.

model          base of the models, shared types
settings_file  read, parse, write
yaml_text      YAML within bounds
faults         messages for faults of a settings file
atomic         whole files or none, SHA-256
outputs        what an output may be
tables         CSV, NPZ and I50N tables
spool          files that are appended to by a thread
"""

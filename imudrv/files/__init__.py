"""Files: settings in YAML, tables, files that grow.

settings_file  read, check and write settings
shipped        files that come with the package, by name
model          base of their models, shared types
yaml_text      YAML within bounds
json_text      JSON within bounds
faults         messages for faults of a settings file
atomic         files written complete or not at all; SHA-256; changes
inputs         files to read, never a device
outputs        checks of the names of outputs
tables         CSV, NPZ and I50N tables
spool          files that a thread appends to
"""

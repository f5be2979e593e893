"""Reports: one content, as text and as HTML with figures.

document        blocks of a document
text, html      renderers
format          numbers and words
figures         matplotlib figures
identification  report of an identification
validation      report of a validation
"""

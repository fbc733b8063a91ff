"""Run the whole pipeline on two robots that the embedded world model has not seen: `hma demo`.

`run` has the stages, `made` their results, `report` the page. In goes an empty folder, out comes report.html.
Next: `hma_model.cli`.
"""

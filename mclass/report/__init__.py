"""An output as one HTML page that needs nothing else: for those without this program.

`document` gathers everything the page shows as plain JSON, `page` puts it into the template in
``web/``. What comes from a log is only ever data there: a string of the JSON, set as text.
"""

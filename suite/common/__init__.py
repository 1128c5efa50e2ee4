"""Parts that several commands use: console, options, errors, reports, charts, parallel work."""

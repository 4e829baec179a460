//! What a person sees of a run: previews, report.json and report.html.

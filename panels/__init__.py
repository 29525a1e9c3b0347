"""The sidebar. Panels draw; they compute nothing."""

"""Readers for logs and maps, the csv writer, and the check of a log's records."""

from kalmap.data.bailey import WorldMap, read_map
from kalmap.data.check import Report, check_log, format_report
from kalmap.data.csv_write import write_csv_log
from kalmap.data.mrclam import mrclam_robots
from kalmap.data.opening import open_log

__all__ = [
    "Report",
    "WorldMap",
    "check_log",
    "format_report",
    "mrclam_robots",
    "open_log",
    "read_map",
    "write_csv_log",
]

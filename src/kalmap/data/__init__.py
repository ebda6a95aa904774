"""Readers for logs and maps, the csv writer, the check of a log's records, and the audit trail."""

from kalmap.data.audit import write_audit
from kalmap.data.audit_read import Audit, open_audit
from kalmap.data.audit_story import Story
from kalmap.data.bailey import WorldMap, read_map
from kalmap.data.check import Report, check_log, format_report
from kalmap.data.csv_write import write_csv_log
from kalmap.data.laser_logs import reader_notes
from kalmap.data.mrclam import mrclam_robots
from kalmap.data.opening import open_log
from kalmap.data.relations import read_relations

__all__ = [
    "Audit",
    "Report",
    "Story",
    "WorldMap",
    "check_log",
    "format_report",
    "mrclam_robots",
    "open_audit",
    "open_log",
    "read_map",
    "read_relations",
    "reader_notes",
    "write_audit",
    "write_csv_log",
]

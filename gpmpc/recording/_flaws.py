"""Names what can be wrong with a recording: what is missing, altered, or unvouched."""

from dataclasses import dataclass

UNFINISHED = "unfinished"  # the file has no end
LOST_CHUNKS = "lost chunks"
LOST_STEPS = "lost steps"
LOST_MESSAGES = "lost messages"
DAMAGED_RECORDS = "damaged records"  # metadata, attachments, heads of records
DAMAGED_INDEX = "damaged index"  # what stands behind the data, for readers that seek
WRONG_CHECKSUM = "wrong checksum"
WRONG_COUNT = "wrong count"
WRONG_ORDER = "wrong order"
NO_CHECKSUMS = "no checksums"  # what is altered would not be noticed
RECOVERED = "recovered"  # the file holds what was left of another
#: with which a recording without steps is none
DAMAGE_KINDS = (LOST_CHUNKS, LOST_STEPS, LOST_MESSAGES, DAMAGED_RECORDS, WRONG_CHECKSUM)


@dataclass(frozen=True)
class Flaw:
    """Something that is wrong with a recording."""

    kind: str  # such as "lost steps"
    count: int  # of chunks, steps, messages or records; 1 where it is of the file
    text: str  # what is wrong and where, in words

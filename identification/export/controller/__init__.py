"""The identified arm as code of a controller: C99 and IEC 61131-3 structured text."""

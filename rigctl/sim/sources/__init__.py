"""Light from elsewhere: folders of pictures, videos, Mitsuba scenes."""

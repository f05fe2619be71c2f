//! How far a work is, on stderr: a bar, or lines where that is no terminal.

use std::fmt;
use std::io::{self, IsTerminal, Write};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use indicatif::{HumanDuration, ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle, TermLike};

/// Where stderr is no terminal: the time to the first line of progress, and from one to the next.
const FIRST_LINE: Duration = Duration::from_secs(2);
const NEXT_LINE: Duration = Duration::from_secs(30);

/// What a bar draws, as lines now and then, for a file or another program.
#[derive(Debug)]
struct Lines {
    drawn: Mutex<String>,
    next: Mutex<Instant>,
}

impl Lines {
    fn new(first: Duration) -> Self {
        Lines { drawn: Mutex::default(), next: Mutex::new(Instant::now() + first) }
    }

    /// What has been drawn, if there is anything and it is time for a line.
    fn due(&self) -> Option<String> {
        let drawn = std::mem::take(&mut *held(&self.drawn));
        let (line, mut next) = (drawn.trim(), held(&self.next));
        if line.is_empty() || Instant::now() < *next {
            return None;
        }
        *next = Instant::now() + NEXT_LINE;
        Some(line.to_owned())
    }
}

impl TermLike for Lines {
    fn width(&self) -> u16 {
        u16::MAX
    }

    fn move_cursor_up(&self, _: usize) -> io::Result<()> {
        Ok(())
    }

    fn move_cursor_down(&self, _: usize) -> io::Result<()> {
        Ok(())
    }

    fn move_cursor_right(&self, _: usize) -> io::Result<()> {
        Ok(())
    }

    fn move_cursor_left(&self, _: usize) -> io::Result<()> {
        Ok(())
    }

    fn write_line(&self, text: &str) -> io::Result<()> {
        self.write_str(text)
    }

    fn write_str(&self, text: &str) -> io::Result<()> {
        held(&self.drawn).push_str(text);
        Ok(())
    }

    fn clear_line(&self) -> io::Result<()> {
        held(&self.drawn).clear();
        Ok(())
    }

    fn flush(&self) -> io::Result<()> {
        self.due().map_or(Ok(()), |line| writeln!(io::stderr(), "{line}"))
    }
}

/// A panic elsewhere leaves these values whole.
fn held<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A bar on stderr that says `what`, how far it is, and the rest of the template; where stderr is no terminal, without the bar, a line now and then.
fn on_stderr(len: Option<u64>, what: &str, rest: &str) -> ProgressBar {
    let (target, drawn) = match io::stderr().is_terminal() {
        true => (ProgressDrawTarget::stderr(), len.map_or("{spinner} ", |_| "{bar:24} ")),
        false => (ProgressDrawTarget::term_like(Box::new(Lines::new(FIRST_LINE))), ""),
    };
    let template = format!("{what} {drawn}{rest}");
    let style = ProgressStyle::with_template(&template).unwrap_or_else(|_| ProgressStyle::default_bar());
    // Before the first is done nothing is known of it.
    let left = |state: &ProgressState, out: &mut dyn fmt::Write| {
        let _ = if state.pos() > 0 { write!(out, ", {} left", HumanDuration(state.eta())) } else { Ok(()) };
    };
    let style = style.with_key("left", left);
    let bar = ProgressBar::with_draw_target(len, target).with_style(style);
    bar.enable_steady_tick(Duration::from_millis(500));
    bar
}

/// Progress on stderr, with position, message and time left.
pub fn bar(len: u64, what: &str) -> ProgressBar {
    on_stderr(Some(len), what, "{pos}/{len}{left}  {msg}")
}

/// Progress on stderr that counts bytes, of so many if that is known.
pub fn bytes(len: Option<u64>, what: &str) -> ProgressBar {
    on_stderr(len, what, len.map_or("{bytes}", |_| "{bytes}/{total_bytes}{left}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_come_now_and_then() {
        let drawn = |lines: &Lines, text| {
            lines.write_str(text).unwrap();
            lines.due()
        };
        let lines = Lines::new(Duration::ZERO);
        assert_eq!(drawn(&lines, "  "), None);
        assert_eq!(drawn(&lines, "views 1/9   "), Some("views 1/9".into()));
        assert_eq!(drawn(&lines, "views 2/9"), None);
        assert_eq!(drawn(&Lines::new(NEXT_LINE), "views 1/9"), None);
    }
}

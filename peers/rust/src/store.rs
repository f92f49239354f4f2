//! E-stops that are open, written down: they outlive the process.

use crate::wire::{decode, encode, Estop};
use std::fs;
use std::io;
use std::path::PathBuf;

/// A folder with a file for each, named by its id.
pub struct Store(pub PathBuf);

impl Store {
    pub fn read(&self) -> Vec<Estop> {
        let files = fs::read_dir(&self.0).into_iter().flatten().flatten();
        files.filter_map(|file| Estop::read(&decode(&fs::read(file.path()).ok()?)?)).collect()
    }

    pub fn write(&self, estop: &Estop) -> io::Result<()> {
        fs::create_dir_all(&self.0)?;
        let fresh = self.0.join(format!("@{}", estop.id)); // no id begins so
        fs::write(&fresh, encode(&estop.value()))?;
        fs::File::open(&fresh)?.sync_all()?;
        fs::rename(fresh, self.0.join(&estop.id))
    }

    pub fn remove(&self, id: &str) -> io::Result<()> {
        match fs::remove_file(self.0.join(id)) {
            Err(bad) if bad.kind() != io::ErrorKind::NotFound => Err(bad),
            _ => Ok(()),
        }
    }
}
